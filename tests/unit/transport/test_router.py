"""Who asks, by which connection, and in which order connections come and go."""

from __future__ import annotations

import logging
import socket
import time
from typing import Any

import zmq

from afspm.clock import ExperimentClock
from afspm.transport.complaints import Complaints
from afspm.transport.network import MAX_REQUEST_BYTES, Network
from afspm.transport.port import ControlConnected
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected, Router
from afspm.transport.zmq_port import ZmqPort

CLOCK = ExperimentClock.real()


class Listening:
    """A router and everything that it has told."""

    def __init__(self, open_: Any) -> None:
        self.network = open_(Network())
        self.router = Router(self.network, "tcp://127.0.0.1:0", Complaints(logging.getLogger("test"), CLOCK))
        self.told: list[Any] = []

    def until(self, count: int, kind: type = PeerAsked) -> list[Any]:
        deadline_s = time.monotonic() + 5.0
        while len(found := [event for event in self.told if isinstance(event, kind)]) < count:
            assert time.monotonic() < deadline_s, self.told
            self.told += self.router.receive() + self.router.follow()
        return found


def peer(plain: Any, listening: Listening, name: bytes, kind: int = zmq.DEALER) -> Any:
    made = plain(kind)
    made.setsockopt(zmq.ROUTING_ID, name) if name else None
    made.connect(listening.router.address)
    return made


def test_req_and_dealer_peers_are_heard_by_name_and_answered(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    for name, kind in ((b"Req", zmq.REQ), (b"Dealer", zmq.DEALER)):
        asking = peer(plain, listening, name, kind)
        asking.send_multipart([b"\7"] if kind == zmq.REQ else [b"", b"\7"])
        asked = listening.until(1)[-1]
        assert (asked.name, asked.frames, asked.user) == (name.decode(), [b"\7"], None)
        listening.router.reply(asked.connection, [b"\0"])
        assert asking.recv_multipart()[-1] == b"\0"
        listening.told.clear()


def test_a_connection_is_told_before_what_it_says_and_its_end_after(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    talking = peer(plain, listening, b"A")
    for n in range(100):
        talking.send_multipart([b"", b"%d" % n])
    talking.close(linger=1000)
    listening.until(1, PeerDisconnected)
    connection = listening.told[0].connection
    expected = [PeerAsked(connection, "A", None, [b"%d" % n]) for n in range(100)]
    assert listening.told == [PeerConnected(connection), *expected, PeerDisconnected(connection)]


def test_a_restarted_peer_comes_after_its_former_life_was_told_to_be_over(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    for _ in range(5):
        asking = peer(plain, listening, b"A")
        asking.send_multipart([b"", b"\7"])
        listening.until(1)
        asking.close(linger=0)
        listening.until(1, PeerDisconnected)
        assert [type(event) for event in listening.told] == [PeerConnected, PeerAsked, PeerDisconnected]
        assert len({event.connection for event in listening.told}) == 1
        listening.told.clear()


def test_who_takes_a_name_is_another_connection_and_who_had_it_comes_back_when_it_asks_again(
    open_: Any, plain: Any, until: Any
) -> None:
    listening, found = Listening(open_), []
    first = open_(ZmqPort(Network(), "A", CLOCK, control=listening.router.address))
    until(lambda: ControlConnected() in found, (first, found))
    first.send([b"\7", b"", b"A/first/1"])
    listening.until(1)
    second = peer(plain, listening, b"A")
    second.send_multipart([b"", b"\7", b"", b"A/second/1"])
    one, two = listening.until(2)
    assert one.connection != two.connection
    found.clear()
    for _ in range(2):  # the second time without an answer to the first
        first.send([b"\7", b"", b"A/first/2"])
    until(lambda: ControlConnected() in found, (first, found))
    first.send([b"\7", b"", b"A/first/2"])
    assert listening.until(3)[-1].frames[2] == b"A/first/2"


def test_peers_without_a_name_have_none(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    for name in (b"", b"\xff\xfe"):
        peer(plain, listening, name).send_multipart([b"", b"\7"])
    assert [asked.name for asked in listening.until(2)] == ["", ""]


def test_what_is_no_request_is_dropped_and_the_next_is_heard(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    talking = peer(plain, listening, b"A")
    for frames in ([b"x"], [b"x", b"", b"\7"], [b""], [b"", b"\7"]):
        talking.send_multipart(frames)
    assert [asked.frames for asked in listening.until(2)] == [[], [b"\7"]]


def test_a_message_that_is_too_large_ends_its_connection_and_nothing_else(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    other = peer(plain, listening, b"Other")
    peer(plain, listening, b"Large").send_multipart([b"", bytes(MAX_REQUEST_BYTES + 1)])
    listening.until(1, PeerDisconnected)
    other.send_multipart([b"", b"\7"])
    assert [asked.name for asked in listening.until(1)] == ["Other"]


def test_those_that_speak_another_protocol_come_and_go(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    port = int(listening.router.address.rpartition(":")[2])
    for sent in (b"", b"GET / HTTP/1.0\r\n\r\n", b"\x01\x00" * 100, b"\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL"):
        with socket.create_connection(("127.0.0.1", port)) as raw:
            raw.sendall(sent)
        listening.until(1, PeerDisconnected)
        assert not [event for event in listening.told if isinstance(event, PeerAsked)]
        listening.told.clear()
    peer(plain, listening, b"A").send_multipart([b"", b"\7"])
    assert listening.until(1)
