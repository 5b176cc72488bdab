"""A request on its way client, scheduler, translator and back, against REQ, ROUTER/DEALER proxy, REP."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any

import zmq

from afspm import wire
from afspm.model import ControlRequest, Request
from afspm.transport.network import Network
from afspm.transport.port import ControlConnected, ReplyReceived
from afspm.transport.zmq_port import ZmqPort
from benchmarks.processes import CLOCK, roles
from benchmarks.rows import Row, alternate, measurement

ROUND_TRIPS = 600
ALTERNATIONS = 9


@measurement
def control_round_trip() -> Iterator[Row]:
    with roles() as processes:
        front, back = processes.start("bare_request_proxy").split()
        processes.start("bare_rep", back=back)
        publish, serve = processes.start("translator").split()
        _, router = processes.scheduler(publish, serve)
        requester: Any = processes.enter_context(zmq.Context()).socket(zmq.REQ)
        requester.connect(front)
        port = ZmqPort(Network(), "Client", CLOCK, control=router)
        processes.callback(port.close)
        while ControlConnected() not in port.poll(1.0):
            pass
        numbers = iter(range(10**9))

        def ask(kind: int, subject: Any) -> None:
            identity = f"Client/benchmark/{next(numbers)}"
            port.send(wire.encode_request(Request(kind, subject, id=identity)))
            while True:
                for incoming in port.poll(5.0):
                    if isinstance(incoming, ReplyReceived) and incoming.response.id == identity:
                        assert incoming.response.ok, incoming
                        return

        def ask_bare() -> None:  # the same frames, there and back, as ours
            requester.send_multipart([b"\1", payload, b"Client/benchmark/%d" % next(numbers)])
            requester.recv_multipart()

        payload = wire.encode_subject("start-scan")
        ask(ControlRequest.REQUEST_CTRL, 0)
        ours, bare = alternate(
            lambda: _median_us(lambda: ask(ControlRequest.ACTION, "start-scan")),
            lambda: _median_us(ask_bare),
            ALTERNATIONS,
        )
        yield Row("control round trip", "µs", ours, bare, 1.5)


def _median_us(round_trip: Callable[[], None]) -> float:
    times = []
    for _ in range(ROUND_TRIPS):
        began = perf_counter()
        round_trip()
        times.append(perf_counter() - began)
    return statistics.median(times) * 1e6
