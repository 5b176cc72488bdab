"""Who takes nothing while much is published is disconnected before more waits for it than may."""

from __future__ import annotations

import socket
import sys
from typing import Any

import pytest
import zmq

from afspm.clock import ExperimentClock
from afspm.transport.history import Published
from afspm.transport.monitor import DISCONNECTED, Monitor
from afspm.transport.network import Network
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.publisher import Publisher
from afspm.transport.subscribers import MOST_REPLAYS, Subscribers
from afspm.transport.zmq_port import ZmqPort

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only there the system tells what waits")
ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()
MB = 2**20
MOST_WAITING, SCAN = 64 * MB, 4 * MB
SOON_S = 10.0


class Lab:
    """A publisher that keeps one packet, and counts how many it has sent that wait for somebody."""

    def __init__(self) -> None:
        self.payload = bytes(SCAN)
        self.events: list[int] = []
        self.network = Network()
        self.published = Published(CLOCK, most_packets=1)
        self.publisher = Publisher(self.network, ANY, self.published, most_waiting_bytes=MOST_WAITING)
        self._monitor = Monitor(self.network, self.publisher.socket, DISCONNECTED)
        self._references = sys.getrefcount(self.payload)

    def poll(self, timeout_s: float) -> list[int]:
        if self.publisher.socket.poll(int(timeout_s * 1000)):
            self.publisher.serve()
        return [event.kind for event in self._monitor.drain()]

    def publish(self) -> None:
        self.publisher.publish(self.published.stamp("Scan2d", self.payload))

    def waiting_bytes(self) -> int:
        return SCAN * (sys.getrefcount(self.payload) - self._references)

    def close(self) -> None:
        self.network.close()


@pytest.fixture
def lab(open_: Any) -> Any:
    return open_(Lab())


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
    lab.publish()
    until(lambda: slow.poll(0), (lab, lab.events))
    for _ in range(MOST_WAITING // SCAN + 10):
        lab.publish()
    until(lambda: DISCONNECTED in lab.events, (lab, lab.events), timeout_s=SOON_S)


def test_a_connection_may_ask_for_a_replay_a_second_and_some_at_once(open_: Any, plain: Any) -> None:
    now_s = [100.0]
    network = open_(Network())
    address = network.bind(network.socket(zmq.XPUB), ANY)
    host, port = address.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as peer:
        subscribers = Subscribers(monotonic_s=lambda: now_s[0])
        assert all(subscribers.may_replay(peer.fileno()) for _ in range(MOST_REPLAYS))
        now_s[0] += 1.0
        assert subscribers.may_replay(peer.fileno())
        assert not subscribers.may_replay(peer.fileno())
        with pytest.raises(OSError, match=r"Broken pipe|reset"):
            peer.send(b"anything")
