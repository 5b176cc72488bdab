"""A late component receives the scheduler's cache, against the same bytes by a bare XPUB and SUB."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter
from typing import Any

import zmq

from afspm import wire
from afspm.transport.network import Network
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort
from benchmarks.codec import scan
from benchmarks.effort import effort
from benchmarks.processes import CLOCK, roles
from benchmarks.roles import ANY
from benchmarks.rows import Row, alternate, measurement

SCANS = effort(50, 2)
ALTERNATIONS = effort(9, 1)


@measurement
def late_joiner() -> Iterator[Row]:
    payload = wire.encode(scan(512))[1]
    with roles() as processes:
        replayer = processes.start("bare_replayer", count=SCANS, size=len(payload))
        translator = ZmqServerPort(Network(), CLOCK, serve=ANY, publish=ANY)
        processes.callback(translator.close)
        source, _ = processes.scheduler(
            str(translator.publish_address), translator.serve_address, cache={"history": {"Scan2d": SCANS}}
        )
        for _ in range(SCANS):
            translator.publish("Scan2d", payload)

        def join() -> tuple[float, int]:
            began, scans = perf_counter(), 0
            port = ZmqPort(Network(), "Late", CLOCK, subscribe=[source], envelopes=["Scan2d"])
            found: list[Any] = []
            while not any(isinstance(incoming, CaughtUp) for incoming in found):
                found = port.poll(0.02)
                translator.poll(0.0)
                scans += sum(isinstance(incoming, PacketReceived) for incoming in found)
            took = perf_counter() - began
            port.close()
            return took, scans

        def join_bare() -> float:
            with zmq.Context() as context:
                began = perf_counter()
                socket: Any = context.socket(zmq.SUB)
                socket.setsockopt(zmq.SUBSCRIBE, b"Scan2d")
                socket.connect(replayer)
                for _ in range(SCANS):
                    socket.recv_multipart(copy=False)
                took = perf_counter() - began
                socket.close()
            return took

        while join()[1] < SCANS:
            pass
        ours, bare = alternate(lambda: join()[0] * 1e3, lambda: join_bare() * 1e3, ALTERNATIONS)
        yield Row(f"a late joiner gets {SCANS} scans of 512²", "ms", ours, bare, 2.0)
