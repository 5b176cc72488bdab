"""A stalled subscriber: its waiting packets are dropped, and it gets them when it continues."""

from __future__ import annotations

import logging
import sys
from typing import Any

import pytest
import zmq
from systems import not_on_wine

from afspm.basics.clock import ExperimentClock
from afspm.transport.late_joiners import PublishedHistory
from afspm.transport.network import DISCONNECTED, LinkTimes, Monitor, Network
from afspm.transport.port import PacketReceived
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.zmq_port import ZmqPort

pytestmark = pytest.mark.skipif(sys.platform == "darwin", reason="the system can't tell that a peer takes nothing")
WITHOUT_MAXRT = not_on_wine("it does not know TCP_MAXRT, by which a peer that takes nothing is disconnected")
ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()
LOG = RateLimitedLog(logging.getLogger("test"), CLOCK)
SCAN = bytes(4_000_000)
SCANS = 40
QUIET = LinkTimes(check=0, stalled=500)


@pytest.fixture
def publisher(open_: Any) -> Any:
    """Return a publisher that waits for a peer for half a second and keeps only its last packet."""
    published = PublishedHistory(CLOCK, most_packets=2 * SCANS, most_bytes=2 * SCANS * len(SCAN))

    class Lab:
        def __init__(self) -> None:
            # heartbeats would let a busy computer disconnect it for another reason
            self.network = Network(times=QUIET)
            self.publisher = Publisher(self.network, ANY, published, published.newest, LOG)
            self._monitor = Monitor(self.network, self.publisher.socket, DISCONNECTED)
            self.address = self.publisher.address

        def poll(self, timeout_s: float) -> list[int]:
            self.publisher.socket.poll(int(timeout_s * 1000))
            self.publisher.serve()
            return [event.kind for event in self._monitor.drain()]

        def publish(self, payload: bytes) -> None:
            self.publisher.publish(published.stamp("Scan2d", payload))

        def close(self) -> None:
            self.network.close()

    return open_(Lab())


@WITHOUT_MAXRT
def test_packets_for_a_stalled_subscriber_are_dropped_and_others_miss_nothing(
    publisher: Any, plain: Any, open_: Any, until: Any
) -> None:
    stalled = plain(zmq.SUB)
    stalled.setsockopt(zmq.RCVHWM, 1)
    stalled.subscribe(b"")
    stalled.connect(publisher.address)
    healthy = open_(ZmqPort(Network(times=QUIET), "Healthy", CLOCK, subscribe=[publisher.address]))
    got: list[Any] = []
    happened: list[Any] = []

    def both_receive() -> bool:
        publisher.publish(b"for both")
        return bool(stalled.poll(0)) and any(isinstance(i, PacketReceived) for i in got)

    until(both_receive, (publisher, []), (healthy, got))
    got.clear()
    payload = bytes(len(SCAN))
    kept = sys.getrefcount(payload)
    for _ in range(SCANS):
        publisher.publisher.socket.send_multipart([b"Scan2d", payload, b""], copy=False)

    def received() -> int:
        return sum(isinstance(i, PacketReceived) and len(i.packet.payload) == len(payload) for i in got)

    until(lambda: received() == SCANS, (publisher, happened), (healthy, got))
    waiting = sys.getrefcount(payload) - kept
    assert waiting > SCANS // 2 or DISCONNECTED in happened
    until(lambda: DISCONNECTED in happened, (publisher, happened))
    until(lambda: sys.getrefcount(payload) - kept <= 1, (publisher, happened))


@WITHOUT_MAXRT
def test_stalled_subscriber_that_continues_gets_everything_once(
    publisher: Any, open_: Any, until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Network.socket

    def socket(self: Network, kind: int, **options: int) -> Any:
        found = made(self, kind, **options)
        if kind == zmq.XSUB:
            found.setsockopt(zmq.RCVHWM, 1)  # else the library reads for it
        return found

    with monkeypatch.context() as patch:
        patch.setattr(Network, "socket", socket)
        stalled = open_(ZmqPort(Network(times=QUIET), "Stalled", CLOCK, subscribe=[publisher.address]))
    got: list[Any] = []
    publisher.publish(b"first")
    until(lambda: any(isinstance(i, PacketReceived) for i in got), (publisher, []), (stalled, got))
    for number in range(SCANS):
        publisher.publish(number.to_bytes() + SCAN)
    happened: list[Any] = []
    until(lambda: DISCONNECTED in happened, (publisher, happened))

    def numbers() -> list[int]:
        return [i.packet.payload[0] for i in got if isinstance(i, PacketReceived)][1:]

    until(lambda: len(numbers()) >= SCANS, (publisher, happened), (stalled, got))
    assert numbers() == list(range(SCANS))
