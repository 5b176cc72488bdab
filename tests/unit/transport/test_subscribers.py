"""Who takes nothing while much is published is disconnected before more waits for it than may."""

from __future__ import annotations

import sys
from typing import Any

import pytest
import zmq

from afspm.clock import ExperimentClock
from afspm.transport.late_joiners import PublishedHistory
from afspm.transport.network import DISCONNECTED, Network
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.publisher import Publisher
from afspm.transport.tcp_guard import MOST_SUBSCRIBED_BYTES
from afspm.transport.zmq_port import ZmqPort

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only there the system tells what waits")
ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()
MB = 2**20
MOST_WAITING, SCAN = 64 * MB, 4 * MB
SOON_S = 10.0


class Lab:
    """A publisher that keeps one packet, and counts how many it has sent that wait for somebody."""

    def __init__(self, gone: Any) -> None:
        self.payload = bytes(SCAN)
        self.events: list[int] = []
        self.network = Network()
        self.published = PublishedHistory(CLOCK, most_packets=1)
        self.publisher = Publisher(self.network, ANY, self.published, most_unsent=MOST_WAITING)
        self._gone = gone(self.publisher)
        self._references = sys.getrefcount(self.payload)

    def poll(self, timeout_s: float) -> list[int]:
        self.publisher.socket.poll(int(timeout_s * 1000))
        self.publisher.serve()
        return self._gone.take()

    def publish(self) -> None:
        self.publisher.publish(self.published.stamp("Scan2d", self.payload))

    def waiting_bytes(self) -> int:
        return SCAN * (sys.getrefcount(self.payload) - self._references)

    def close(self) -> None:
        self.network.close()


@pytest.fixture
def lab(open_: Any, gone: Any) -> Any:
    return open_(Lab(gone))


@pytest.fixture
def standing(lab: Any, open_: Any, until: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A subscriber that has joined and is polled no more; the library does not read for it, either."""
    made = Network.socket

    def socket(self: Network, kind: int, **options: int) -> Any:
        found = made(self, kind, **options)
        if kind == zmq.XSUB:
            found.setsockopt(zmq.RCVHWM, 1)
        return found

    monkeypatch.setattr(Network, "socket", socket)
    port, got = open_(ZmqPort(Network(), "Standing", CLOCK, subscribe=[lab.publisher.address])), []
    monkeypatch.undo()
    until(lambda: any(isinstance(i, CaughtUp) for i in got), (lab, lab.events), (port, got))
    return port


def test_no_more_waits_for_one_that_stands_still_than_may_and_others_get_everything(
    lab: Any, standing: Any, open_: Any, until: Any
) -> None:
    healthy, got = open_(ZmqPort(Network(), "Healthy", CLOCK, subscribe=[lab.publisher.address])), []
    until(lambda: any(isinstance(i, CaughtUp) for i in got), (lab, lab.events), (healthy, got))
    received = lambda: sum(isinstance(i, PacketReceived) for i in got)  # noqa: E731
    most = 0
    for number in range(1, 41):
        lab.publish()
        until(lambda number=number: received() == number, (lab, lab.events), (healthy, got))
        most = max(most, lab.waiting_bytes())
    until(lambda: DISCONNECTED in lab.events, (lab, lab.events), timeout_s=SOON_S)
    # the packet that is remembered, one that is being sent, and what is published between two looks
    assert MOST_WAITING // 2 < most <= MOST_WAITING + 2 * SCAN + 8 * MB
    assert lab.events == [DISCONNECTED]
    until(lambda: lab.waiting_bytes() <= SCAN, (lab, lab.events))

    late: list[Any] = []  # once it goes on, it asks for what it missed
    until(lambda: sum(isinstance(i, CaughtUp) for i in late) == 1, (lab, lab.events), (standing, late))
    newest_ns = max(i.packet.time_ns for i in got if isinstance(i, PacketReceived))
    times = [i.packet.time_ns for i in late if isinstance(i, PacketReceived)]
    assert times == sorted(set(times))
    assert times[-1] == newest_ns


def test_one_that_stands_still_for_less_than_may_wait_stays_and_gets_everything(
    lab: Any, standing: Any, until: Any
) -> None:
    count = MOST_WAITING // SCAN - 2
    for _ in range(count):
        lab.publish()
    late: list[Any] = []
    until(lambda: sum(isinstance(i, PacketReceived) for i in late) == count, (lab, lab.events), (standing, late))
    assert lab.events == []


def test_much_over_time_disconnects_nobody_who_takes_it(lab: Any, open_: Any, until: Any) -> None:
    healthy, got = open_(ZmqPort(Network(), "Healthy", CLOCK, subscribe=[lab.publisher.address])), []
    until(lambda: any(isinstance(i, CaughtUp) for i in got), (lab, lab.events), (healthy, got))
    lab.payload, count = bytes(SCAN // 4), 4 * MOST_WAITING // SCAN
    for number in range(1, 3 * count + 1):
        lab.publish()
        until(
            lambda number=number: sum(isinstance(i, PacketReceived) for i in got) == number,
            (lab, lab.events),
            (healthy, got),
        )
    assert lab.events == []


def test_a_plain_subscriber_that_takes_nothing_is_disconnected_when_too_much_waits(
    lab: Any, plain: Any, until: Any
) -> None:
    slow = plain(zmq.SUB)
    slow.setsockopt(zmq.RCVHWM, 1)
    slow.subscribe(b"Scan")
    slow.connect(lab.publisher.address)
    until(lambda: lab.publish() or slow.poll(0), (lab, lab.events))
    for _ in range(MOST_WAITING // SCAN + 10):
        lab.publish()
    until(lambda: DISCONNECTED in lab.events, (lab, lab.events), timeout_s=SOON_S)


def test_one_that_asks_for_replays_again_and_again_is_disconnected(lab: Any, plain: Any, until: Any) -> None:
    asking = plain(zmq.XSUB)
    asking.connect(lab.publisher.address)
    for n in range(500):  # fewer than wait for a connection at most
        asking.send(b"\1\0replay/a/%d\0-1\0" % n + bytes([65]) * (MOST_SUBSCRIBED_BYTES // 200))
    until(lambda: DISCONNECTED in lab.events, (lab, lab.events), timeout_s=SOON_S)
