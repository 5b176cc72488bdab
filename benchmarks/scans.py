"""Scans through the scheduler to many subscribers, against PUB, XSUB/XPUB proxy, SUB.

The scheduler writes each packet into a file before it publishes it. So does the proxy for comparison; a proxy without a
file has a row of its own. Beside that one, 0.7 can't be reached on two cores: a scan of 512² is copied four times
through a bare proxy, and the file is one copy more, with a checksum, and on the disk 0.1 s later. To one subscriber
there is little else to do: 240 scans of 512² a second, 2,400 of 128². A scan takes seconds, so these targets only keep
the rates.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from functools import partial
from time import perf_counter
from typing import Any

import zmq

from afspm import wire
from afspm.transport.network import Network
from afspm.transport.zmq_server import ZmqServerPort
from benchmarks.codec import scan
from benchmarks.effort import effort
from benchmarks.processes import CLOCK, Roles, roles
from benchmarks.roles import ANY, LAST, MARK
from benchmarks.rows import Row, alternate, measurement

SCANS = effort(
    {128: (400, 31), 512: (60, 15), 2048: (8, 5)},
    {128: (4, 1), 512: (2, 1), 2048: (1, 1)},
)
"""By edge in pixels: how many are published in a batch, and how many batches: a short one says little by itself. All of
a batch may be under way, so no queue is shorter."""
QUEUE = 1000


class Line:
    """A publisher in this process, scheduler or proxy in another, and subscribers each in its own."""

    def __init__(self, processes: Roles) -> None:
        self._publish: Callable[[bytes, bytes], None]
        self.rest: Callable[[float], object]
        """Waits, and sees to what comes meanwhile."""
        self._context: Any = processes.enter_context(zmq.Context())
        self._tally = self._context.socket(zmq.PULL)
        self._tally_address = f"tcp://127.0.0.1:{self._tally.bind_to_random_port('tcp://127.0.0.1')}"
        self._processes = processes

    def bare(self, subscribers: int, *, logged: bool = False) -> None:
        publisher = self._context.socket(zmq.PUB)
        publisher.set_hwm(QUEUE)
        source = f"tcp://127.0.0.1:{publisher.bind_to_random_port('tcp://127.0.0.1')}"
        proxy = "bare_logging_proxy" if logged else "bare_packet_proxy"
        middle = self._processes.start(proxy, publisher=source, queue=QUEUE)
        for _ in range(subscribers):
            self._processes.start("bare_subscriber", source=middle, tally=self._tally_address, queue=QUEUE)

        def publish(envelope: bytes, payload: bytes) -> None:
            stamp = wire.encode_time(CLOCK.now_ns())
            publisher.send(envelope, zmq.SNDMORE)
            publisher.send(payload, zmq.SNDMORE, copy=False)
            publisher.send(stamp)

        self._publish = publish
        self._wait_for(subscribers)

    def ours(self, subscribers: int, *, recorded: bool = False) -> None:
        port = ZmqServerPort(Network(), CLOCK, serve=ANY, publish=ANY)
        self._processes.callback(port.close)
        middle, _ = self._processes.scheduler(str(port.publish_address), port.serve_address, recorded=recorded)
        for n in range(subscribers):
            self._processes.start("our_subscriber", source=middle, tally=self._tally_address, name=f"Subscriber {n}")

        def publish(envelope: bytes, payload: bytes) -> None:
            port.publish(envelope.decode(), payload)

        while not self._tally.poll(0):
            port.poll(0.05)
            publish(MARK.encode(), b"")
        self._publish = publish
        self.rest = port.poll
        self._wait_for(subscribers)

    def _wait_for(self, subscribers: int) -> None:
        self._subscribers = subscribers
        there = 0
        while there < subscribers:
            self._publish(MARK.encode(), b"")
            if self._tally.poll(20):
                there += self._tally.recv() == b"there"

    def scans_per_s(self, payload: bytes, count: int) -> float:
        """Return the rate at which scans arrive at every subscriber."""
        gc.collect()
        began = perf_counter()
        for _ in range(count):
            self._publish(b"Scan2d", payload)
        self._publish(MARK.encode(), LAST)
        for _ in range(self._subscribers):
            arrived = int(self._tally.recv())
            assert arrived == count, f"{count - arrived} of {count} scans were lost"
        return count / (perf_counter() - began)


@measurement
def scans() -> Iterator[Row]:
    for subscribers in (1, 4, 16):
        with roles() as processes:
            bare, ours = Line(processes), Line(processes)
            bare.bare(subscribers, logged=True)
            ours.ours(subscribers)
            for pixels, (count, batches) in SCANS.items():
                payload = wire.encode(scan(pixels))[1]
                fast, reference = alternate(
                    partial(ours.scans_per_s, payload, count),
                    partial(bare.scans_per_s, payload, count),
                    batches,
                )
                # with one subscriber there is least to send, and what each packet costs beside shows most
                target = 0.35 if subscribers == 1 and pixels < 2048 else 0.7
                yield Row(f"scans of {pixels}² to {subscribers} subscribers", "1/s", fast, reference, target, "high")


@measurement
def scans_beside_a_proxy_without_a_log() -> Iterator[Row]:
    """Measure the cost of the log: a write of each packet into a file, on the same two cores."""
    with roles() as processes:
        bare, ours = Line(processes), Line(processes)
        bare.bare(1)
        ours.ours(1)
        for pixels, (count, batches) in SCANS.items():
            payload = wire.encode(scan(pixels))[1]
            fast, reference = alternate(
                partial(ours.scans_per_s, payload, count), partial(bare.scans_per_s, payload, count), batches
            )
            yield Row(f"scans of {pixels}², beside a proxy without a log", "1/s", fast, reference, 0.25, "high")
