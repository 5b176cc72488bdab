"""Crowds of plain subscribers share replays, and a packet that was dropped on its way is found by the beacon."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Hashable
from typing import Any

import pytest
import zmq

from afspm.basics.clock import ExperimentClock
from afspm.model import Packet
from afspm.transport import late_joiners, publisher, subscriber
from afspm.transport.late_joiners import BEACON, Marker, PublishedHistory, decode_newest
from afspm.transport.network import QUEUE_LENGTH, LinkTimes, Network
from afspm.transport.port import CaughtUp, Killed, PacketReceived
from afspm.transport.publisher import Publisher
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.zmq_port import ZmqPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()
LOG = RateLimitedLog(logging.getLogger("test"), CLOCK)


class PublisherLab:
    """A publisher that counts its replays, and can lose a packet as a full queue does."""

    def __init__(self, times: LinkTimes | None = None) -> None:
        self.published = PublishedHistory(CLOCK, most_packets=2 * QUEUE_LENGTH)
        self.replays: list[tuple[str, ...]] = []
        self.network = Network(times=times)
        self.publisher = Publisher(self.network, ANY, self._history, self.published.newest, LOG)
        self.address = self.publisher.address

    def _history(self, who: Hashable, prefixes: tuple[str, ...], since_ns: int) -> list[Packet]:
        self.replays.append(prefixes)
        return self.published(who, prefixes, since_ns)

    def publish(self, envelope: str, payload: bytes, *, keep: bool = True, is_lost: bool = False) -> None:
        packet = self.published.stamp(envelope, payload, keep=keep)
        if not is_lost:
            self.publisher.publish(packet)

    def poll(self, timeout_s: float) -> list[Any]:
        left_s = min(timeout_s, self.publisher.due_s - time.monotonic())
        self.publisher.socket.poll(max(0, round(left_s * 1000)))
        self.publisher.serve()
        return []

    def close(self) -> None:
        self.network.close()


@pytest.fixture
def lab(open_: Any) -> PublisherLab:
    made: PublisherLab = open_(PublisherLab())
    return made


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beacons follow each other quickly."""
    monkeypatch.setattr(publisher, "_BEACON_S", 0.02)


def read(socket: Any, got: list[list[bytes]]) -> None:
    while socket.poll(0):
        got.append(socket.recv_multipart())


def test_plain_subscribers_that_join_together_share_one_replay(lab: PublisherLab, plain: Any, until: Any) -> None:
    # faults 3
    for number in range(50):
        lab.publish("Scan2d", b"%d" % number)
    sockets = [plain(zmq.SUB) for _ in range(40)]
    got: list[list[list[bytes]]] = [[] for _ in sockets]
    began_s = time.monotonic()
    for socket in sockets:
        for prefix in (b"Scan2d", b"ScopeStateMsg", b"KILL"):
            socket.subscribe(prefix)
        socket.connect(lab.address)
        lab.poll(0.02)

    def all_have_all() -> bool:
        for socket, received in zip(sockets, got, strict=True):
            read(socket, received)
        return all(len({frames[1] for frames in received}) == 50 for received in got)

    until(all_have_all, (lab, []))
    most = 2 + int(time.monotonic() - began_s)  # one each second, and a computer that pauses spreads the joins
    assert len(lab.replays) <= most
    assert max(map(len, got)) <= most * 50


def test_replay_to_plain_subscribers_leaves_room_for_newer_packets(open_: Any, plain: Any, until: Any) -> None:
    # faults 3
    lab = open_(PublisherLab(times=LinkTimes(stalled=60_000)))
    slow, late = plain(zmq.SUB), plain(zmq.SUB)
    slow.setsockopt(zmq.RCVHWM, 1)
    slow.setsockopt(zmq.RCVBUF, 1 << 16)
    late.setsockopt(zmq.RCVHWM, 0)
    slow.subscribe(b"Scan2d")
    slow.connect(lab.address)
    until(lambda: lab.replays, (lab, []))
    kept, newer = QUEUE_LENGTH * 9 // 10, QUEUE_LENGTH * 3 // 10
    for number in range(kept):
        lab.published.stamp("Scan2d", b"%d" % number + bytes(10_000))
    late.subscribe(b"Scan2d")
    late.connect(lab.address)
    of_slow: list[list[bytes]] = []
    of_late: list[list[bytes]] = []

    def late_has(count: int) -> Callable[[], bool]:
        def has() -> bool:
            read(late, of_late)
            return len({frames[2] for frames in of_late}) >= count

        return has

    until(late_has(QUEUE_LENGTH // 2), (lab, []))
    for _ in range(newer):
        lab.publish("Scan2d_newer", b"newer")

    def slow_has_all() -> bool:
        read(slow, of_slow)
        return len({frames[2] for frames in of_slow}) >= kept + newer

    until(slow_has_all, (lab, []))
    until(late_has(kept + newer), (lab, []))
    assert of_late[-1][0] == b"Scan2d_newer", "the newest packets come last, so that a receiver believes the last state"


@pytest.mark.usefixtures("quick")
def test_lacking_packet_is_requested_and_the_log_says_so(
    lab: PublisherLab, open_: Any, until: Any, caplog: pytest.LogCaptureFixture
) -> None:
    # faults 3
    got: list[Any] = []
    port = open_(ZmqPort(Network(), "Series", CLOCK, subscribe=[lab.address]))
    until(lambda: CaughtUp(lab.address) in got, (lab, []), (port, got))
    lab.publish("Scan2d_2000.0_Height", b"49")
    lab.publish("ScopeStateMsg", b"free", is_lost=True)
    lab.publish("LogLines", b"newer")

    def payloads() -> set[bytes]:
        return {bytes(incoming.packet.payload) for incoming in got if isinstance(incoming, PacketReceived)}

    until(lambda: payloads() == {b"49", b"free", b"newer"}, (lab, []), (port, got))
    assert lab.replays == [("",), ("ScopeStateMsg",)]
    assert got.count(CaughtUp(lab.address)) == 1
    assert "Series lacks the newest packet of ScopeStateMsg of tcp://" in caplog.text
    assert sum(isinstance(incoming, PacketReceived) for incoming in got) == 3


@pytest.mark.usefixtures("quick")
def test_no_packet_is_missed_that_is_not_subscribed_not_kept_or_gone(
    lab: PublisherLab, open_: Any, until: Any, caplog: pytest.LogCaptureFixture
) -> None:
    got: list[Any] = []
    port = open_(ZmqPort(Network(), "Series", CLOCK, subscribe=[lab.address], envelopes=["Scan"]))
    until(lambda: CaughtUp(lab.address) in got, (lab, []), (port, got))
    lab.publish("Spec1d", b"not subscribed", is_lost=True)
    lab.publish("ScanLines", b"not kept", keep=False, is_lost=True)
    gone = lab.published.newest
    lab.publisher.newest = lambda: {**gone(), "Scan2d": 10**18}
    lab.publish("Scan2d_1", b"one")
    until(lambda: "no longer keeps the newest packet of Scan2d" in caplog.text, (lab, []), (port, got))
    for number in range(2, 6):
        lab.publish(f"Scan2d_{number}", b"one more")  # and so another beacon, after which it is not requested again
        until(
            lambda number=number: any(
                isinstance(one, PacketReceived) and one.packet.envelope == f"Scan2d_{number}" for one in got
            ),
            (lab, []),
            (port, got),
        )
        lab.poll(0.05)
    assert lab.replays == [("Scan", "KILL"), ("Scan2d",)]
    assert "Spec1d" not in caplog.text


def test_beacon_reaches_only_subscribers_with_a_marker(lab: PublisherLab, plain: Any, until: Any) -> None:
    theirs, ours = plain(zmq.SUB), plain(zmq.XSUB)
    theirs.subscribe(b"")
    for socket in (theirs, ours):
        socket.connect(lab.address)
    topic = late_joiners.topic("Ours", 0)
    ours.send(b"\1" + Marker(topic, -1, ("",)).encode())
    lab.publish("Scan2d", b"scan")
    of_theirs: list[list[bytes]] = []
    of_ours: list[list[bytes]] = []

    def has_beacon() -> bool:
        read(theirs, of_theirs)
        read(ours, of_ours)
        return any(frames[0] == BEACON for frames in of_ours) and bool(of_theirs)

    until(has_beacon, (lab, []))
    lab.publisher.kill()
    until(lambda: read(theirs, of_theirs) or of_theirs[-1] == [b"KILL"], (lab, []))
    (beacon,) = [frames for frames in of_ours if frames[0] == BEACON]
    assert decode_newest(beacon[1]) == lab.published.newest()
    assert {frames[0] for frames in of_theirs} == {b"Scan2d", b"KILL"}


@pytest.mark.usefixtures("quick")
def test_signal_of_the_end_is_repeated_for_a_subscriber_that_has_lost_it(
    lab: PublisherLab, open_: Any, until: Any
) -> None:
    got: list[Any] = []
    port = open_(ZmqPort(Network(), "Series", CLOCK, subscribe=[lab.address]))
    until(lambda: CaughtUp(lab.address) in got, (lab, []), (port, got))
    lab.publisher.kill()
    until(lambda: got.count(Killed()) > 1, (lab, []), (port, got))


def test_request_without_an_answer_is_repeated(
    open_: Any, plain: Any, until: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # faults 3: a full queue may drop the end of a replay, too
    monkeypatch.setattr(subscriber, "_ANSWERED_WITHIN_S", 0.05)
    theirs = plain(zmq.XPUB)
    address = f"tcp://127.0.0.1:{theirs.bind_to_random_port('tcp://127.0.0.1')}"
    got: list[Any] = []
    port = open_(ZmqPort(Network(), "Series", CLOCK, subscribe=[address]))
    markers: list[bytes] = []

    def asks(count: int) -> Callable[[], bool]:
        def has_asked() -> bool:
            theirs.send_multipart([BEACON, b""])
            while theirs.poll(0):
                message = theirs.recv()
                if message.startswith(b"\1\0replay/"):
                    markers.append(message[1:])
            return len(markers) >= count

        return has_asked

    theirs.setsockopt(zmq.XPUB_MANUAL, 1)
    until(lambda: theirs.poll(0), (port, got))
    theirs.recv()
    theirs.setsockopt(zmq.SUBSCRIBE, b"")
    until(asks(2), (port, got))
    marker = Marker.decode(markers[-1])
    assert marker is not None
    theirs.send(marker.topic)
    until(lambda: CaughtUp(address) in got, (port, got))
