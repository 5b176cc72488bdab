"""A request from client through scheduler to translator and back, against REQ, ROUTER/DEALER proxy, REP.

The bare proxy neither reads a request nor keeps it. Ours takes 0.8 to 1.1 ms on two cores, and 1.3 to 1.8 ms
with its key saved: less than a hundredth of a scan of 0.3 s. The targets keep it there.
"""

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
from benchmarks.effort import effort
from benchmarks.processes import CLOCK, Roles, roles
from benchmarks.rows import Row, alternate, measurement

ROUND_TRIPS = effort(600, 3)
ALTERNATIONS = effort(9, 1)


class Client:
    """A component in control."""

    def __init__(self, processes: Roles, router: str) -> None:
        self._port = ZmqPort(Network(), "Client", CLOCK, control=router)
        processes.callback(self._port.close)
        while ControlConnected() not in self._port.poll(1.0):
            pass
        self._asked = 0
        self._ask(ControlRequest.REQUEST_CTRL, 0)

    def act(self) -> None:
        """Send one action and wait for its answer."""
        self._ask(ControlRequest.ACTION, "stop-scan")

    def start(self) -> None:
        """Start a measurement: its key is saved before the request is forwarded."""
        self._ask(ControlRequest.ACTION, "start-scan")

    def round_trip_us(self) -> float:
        """Return the median of many round trips."""
        return _median_us(self.act)

    def round_trips_us(self, seconds: float) -> list[float]:
        """Return the round trips within this time, one after the other."""
        began, took = perf_counter(), []
        while (now := perf_counter()) < began + seconds:
            self.act()
            took.append((perf_counter() - now) * 1e6)
        return took

    def _ask(self, kind: int, subject: Any) -> None:
        self._asked += 1
        identity = f"Client/benchmark/{self._asked}"
        self._port.send(wire.encode_request(Request(kind, subject, id=identity)))
        while True:
            for incoming in self._port.poll(5.0):
                if isinstance(incoming, ReplyReceived) and incoming.response.id == identity:
                    assert incoming.response.ok, incoming
                    return


@measurement
def control_round_trip() -> Iterator[Row]:
    with roles() as processes:
        front, back = processes.start("bare_request_proxy").split()
        processes.start("bare_rep", back=back)
        publish, serve = processes.start("translator").split()
        _, router = processes.scheduler(publish, serve)
        client = Client(processes, router)
        requester: Any = processes.enter_context(zmq.Context()).socket(zmq.REQ)
        requester.connect(front)
        numbers = iter(range(10**9))

        def ask_bare() -> None:  # the same frames, there and back, as ours
            requester.send_multipart([b"\1", payload, b"Client/benchmark/%d" % next(numbers)])
            requester.recv_multipart()

        payload = wire.encode_subject("stop-scan")
        ours, bare = alternate(lambda: _median_us(client.act), lambda: _median_us(ask_bare), ALTERNATIONS)
        yield Row("control round trip", "µs", ours, bare, 5.0)
        starts, bare = alternate(lambda: _median_us(client.start), lambda: _median_us(ask_bare), ALTERNATIONS)
        yield Row("control round trip of the start of a scan, whose key is saved first", "µs", starts, bare, 8.0)


def _median_us(round_trip: Callable[[], None]) -> float:
    times = []
    for _ in range(ROUND_TRIPS):
        began = perf_counter()
        round_trip()
        times.append(perf_counter() - began)
    return statistics.median(times) * 1e6
