"""Who asks, by which connection, and in which order connections come and go."""

from __future__ import annotations

import logging
import socket
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zmq

from afspm import wire
from afspm.clock import ExperimentClock
from afspm.model import CLOCK_REQUEST, Request, Response
from afspm.transport import router
from afspm.transport.keys import GUEST, Keys, pair
from afspm.transport.network import ACCEPTED, DISCONNECTED, MAX_REQUEST_BYTES, ConnectionEvent, Network
from afspm.transport.port import ControlConnected, ReplyReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected, Router
from afspm.transport.zmq_port import ZmqPort

CLOCK = ExperimentClock.real()


class Listening:
    """A router and everything that it has told."""

    def __init__(self, open_: Any, own: Keys | None = None) -> None:
        self.network = open_(Network(own))
        self.router = Router(self.network, "tcp://127.0.0.1:0", RateLimitedLog(logging.getLogger("test"), CLOCK))
        self.told: list[Any] = []

    def until(self, count: int, kind: type = PeerAsked, *ports: ZmqPort) -> list[Any]:
        """What was told of a kind, once it is so much; `ports` of ours are waited for meanwhile."""
        deadline_s = time.monotonic() + 5.0
        while len(found := [event for event in self.told if isinstance(event, kind)]) < count:
            assert time.monotonic() < deadline_s, self.told
            self.told += self.router.receive()
            for port in ports:
                port.poll(0.001)
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
    listening.until(1, PeerAsked, first)
    second = peer(plain, listening, b"A")
    second.send_multipart([b"", b"\7", b"", b"A/second/1"])
    one, two = listening.until(2)
    assert one.connection != two.connection
    found.clear()
    for _ in range(2):  # the second time without an answer to the first
        first.send([b"\7", b"", b"A/first/2"])
    until(lambda: ControlConnected() in found, (first, found))
    first.send([b"\7", b"", b"A/first/2"])
    greeting, asked = listening.until(4)[-2:]
    assert (greeting.frames[2], asked.frames[2]) == (b"A/first/0", b"A/first/2")


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


@pytest.fixture
def raw() -> Iterator[Callable[..., Raw]]:
    made: list[Raw] = []

    def make(name: bytes, kind: bytes = b"DEALER") -> Raw:
        made.append(Raw(name, kind))
        return made[-1]

    yield make
    for one in made:
        one.socket.close()


class Raw:
    """A peer by hand: its socket is there before it connects and stays after it has left, so that the router's
    next connection has the descriptor of the last."""

    def __init__(self, name: bytes, kind: bytes) -> None:
        self.socket = socket.socket()
        told = ((b"Socket-Type", kind), (b"Identity", name))
        properties = [bytes([len(key)]) + key + bytes([0, 0, 0, len(value)]) + value for key, value in told]
        self._ready = b"\x05READY" + b"".join(properties)

    def connect(self, listening: Listening) -> None:
        host, port = listening.router.address.removeprefix("tcp://").split(":")
        self.socket.connect((host, int(port)))

    def say(self, what: bytes, *, first: bool = False) -> None:
        if first:
            greeting = b"\xff" + bytes(7) + b"\1\x7f\3\1NULL" + bytes(16 + 1 + 31)
            self.socket.sendall(greeting + bytes([4, len(self._ready)]) + self._ready)
            heard = b""
            while b"\x05READY" not in heard:
                heard += self.socket.recv(1000)
        self.socket.sendall(bytes([1, 0, 0, len(what)]) + what)

    def leave(self) -> None:
        self.socket.shutdown(socket.SHUT_RDWR)


def happened(listening: Listening, kind: int) -> list[ConnectionEvent]:
    """What the monitor tells up to an event of a kind."""
    events: list[ConnectionEvent] = []
    deadline_s = time.monotonic() + 5.0
    while not any(event.kind == kind for event in events):
        assert time.monotonic() < deadline_s
        events += listening.router.monitor.drain()
    return events


def follows(listening: Listening, monkeypatch: pytest.MonkeyPatch, *rounds: list[ConnectionEvent]) -> list[Any]:
    """What the router tells of these events, seen all at once."""
    left = list(rounds)
    monkeypatch.setattr(listening.router.monitor, "drain", lambda: left.pop(0) if left else [])
    told = listening.router.receive()
    monkeypatch.undo()
    return told


@pytest.mark.parametrize("in_time", [True, False])
def test_last_words_are_not_taken_for_those_of_who_has_the_descriptor_next(
    open_: Any, raw: Callable[..., Raw], monkeypatch: pytest.MonkeyPatch, in_time: bool
) -> None:
    listening, series, witness = Listening(open_), raw(b"series"), raw(b"witness")
    series.connect(listening)
    series.say(b"1", first=True)
    (first,) = listening.until(1)
    series.say(b"2")
    series.leave()
    gone, told = happened(listening, DISCONNECTED), []
    if not in_time:  # the socket told of the end before it gave out the last words
        with monkeypatch.context() as patched:
            patched.setattr(router, "receive_frames", lambda socket: [])
            told += follows(listening, patched, gone)
        assert told == [PeerDisconnected(first.connection)]
        gone = []
    witness.connect(listening)
    came = happened(listening, ACCEPTED)
    told += follows(listening, monkeypatch, [*gone, *came])
    assert {event.value for event in came} == {first_descriptor(listening)}
    last = [PeerAsked(first.connection, "series", None, [b"2"])] if in_time else []
    assert told == [*last, PeerDisconnected(first.connection), PeerConnected(2)]
    witness.say(b"3", first=True)
    assert listening.until(2)[-1] == PeerAsked(2, "witness", None, [b"3"])


def first_descriptor(listening: Listening) -> int:
    (descriptor,) = listening.router._open
    return descriptor


@pytest.mark.skipif(sys.platform == "win32", reason="a descriptor is not given anew at once there")
@pytest.mark.parametrize("kind", [b"DEALER", b"REQ"])
def test_the_first_words_of_a_next_life_on_the_same_descriptor_are_its_own(
    open_: Any, raw: Callable[..., Raw], monkeypatch: pytest.MonkeyPatch, kind: bytes
) -> None:
    listening, series, again = Listening(open_), raw(b"series", kind), raw(b"series", kind)
    series.connect(listening)
    series.say(b"1", first=True)
    listening.until(1)
    descriptor = first_descriptor(listening)
    series.leave()
    events = happened(listening, DISCONNECTED)
    again.connect(listening)
    events += happened(listening, ACCEPTED)
    again.say(b"2", first=True)
    assert listening.router.socket.poll(5000)
    told = follows(listening, monkeypatch, events)
    assert told == [PeerDisconnected(1), PeerConnected(2), PeerAsked(2, "series", None, [b"2"])]
    assert first_descriptor(listening) == descriptor
    listening.router.reply(2, [b"heard"])
    heard = b""
    while not heard.endswith(b"heard"):
        heard += again.socket.recv(1000)
    assert heard.startswith(b"\0\0") is (kind == b"DEALER")  # an empty frame, to see whether it is there


def test_to_be_looked_for_disturbs_no_component(open_: Any, until: Any, caplog: pytest.LogCaptureFixture) -> None:
    listening, found = Listening(open_), []
    component = open_(ZmqPort(Network(), "A", CLOCK, control=listening.router.address))
    until(lambda: ControlConnected() in found, (component, found))
    component.send([b"\7", b"", b"A/first/1"])
    (asked,) = listening.until(1, PeerAsked, component)
    listening.router.socket.send_multipart([b"A", b""])
    listening.router.reply(asked.connection, wire.encode_response(Response(0, id="A/first/1")))
    until(lambda: any(isinstance(one, ReplyReceived) for one in found), (component, found))
    assert not caplog.records


class Run:
    """A router with keys that were made for a run, and clients of it."""

    def __init__(self, open_: Any) -> None:
        self._open = open_
        self.pairs = {name: pair() for name in ("scheduler", "series", "thief", GUEST)}
        peers = {public: name for name, (public, _) in self.pairs.items()}
        self.listening = Listening(open_, Keys("scheduler", *self.pairs["scheduler"], peers, everywhere=False))

    def keys(self, name: str) -> Keys:
        address = self.listening.router.address
        peers = {self.pairs["scheduler"][0]: "scheduler"}
        return Keys(name, *self.pairs[name], peers, {address: "scheduler"}, everywhere=False, guards=False)

    def client(self, name: str, claimed: str = "") -> ZmqPort:
        network = Network(self.keys(name))
        port: ZmqPort = self._open(ZmqPort(network, claimed or name, CLOCK, control=self.listening.router.address))
        found: list[Any] = []
        deadline_s = time.monotonic() + 5.0
        while ControlConnected() not in found:
            assert time.monotonic() < deadline_s
            found += port.poll(0.01)
            self.listening.told += self.listening.router.receive()
        return port


def answered(port: ZmqPort) -> list[bytes]:
    """The payloads of what the port is answered within a moment."""
    found: list[Any] = []
    deadline_s = time.monotonic() + 0.5
    while not found and time.monotonic() < deadline_s:
        found += [incoming for incoming in port.poll(0.05) if isinstance(incoming, ReplyReceived)]
    return [bytes(incoming.response.payload) for incoming in found]


def test_nobody_takes_the_answers_of_another_by_its_name(open_: Any, plain: Any) -> None:
    run = Run(open_)
    series = run.client("series")
    series.send(wire.encode_request(Request(CLOCK_REQUEST, id="series/x/1")))
    (asked,) = run.listening.until(1, PeerAsked, series)
    assert (asked.name, asked.user) == ("series", "series")
    thief = run.client("thief", "series")
    bare = plain(zmq.DEALER)
    bare.setsockopt(zmq.ROUTING_ID, b"series")
    own = run.keys("thief")
    bare.curve_publickey, bare.curve_secretkey, bare.curve_serverkey = own.public, own.secret, own.server_key(
        run.listening.router.address
    )  # fmt: skip
    bare.connect(run.listening.router.address)
    thief.send(wire.encode_request(Request(CLOCK_REQUEST, id="series/y/1")))
    bare.send_multipart([b"", *wire.encode_request(Request(CLOCK_REQUEST, id="series/z/1"))])
    assert {(one.name, one.user) for one in run.listening.until(3, PeerAsked, thief)[1:]} == {("series", "thief")}
    run.listening.router.reply(asked.connection, wire.encode_response(Response(0, b"hers", id="series/x/1")))
    assert answered(series) == [b"hers"]
    assert answered(thief) == []
    assert bare.poll(100) == 0


def test_one_that_is_started_again_has_its_name_again_while_its_old_connection_stands(open_: Any) -> None:
    run = Run(open_)
    for life in range(2):
        port = run.client("series")
        port.send(wire.encode_request(Request(CLOCK_REQUEST, id=f"series/{life}/1")))
        asked = run.listening.until(life + 1, PeerAsked, port)[-1]
    assert (asked.name, asked.user) == ("series", "series")
    run.listening.router.reply(asked.connection, wire.encode_response(Response(0, b"anew", id="series/1/1")))
    assert answered(port) == [b"anew"]


def test_guests_have_any_name_but_that_of_a_process(open_: Any) -> None:
    run = Run(open_)
    heard = []
    for n, name in enumerate(("notebook", "dashboard:Ada", "series", "series:Ada", "scheduler", GUEST)):
        client = run.client(GUEST, name)
        client.send(wire.encode_request(Request(CLOCK_REQUEST, id="x")))
        heard.append(run.listening.until(n + 1, PeerAsked, client)[-1].user)
    assert heard == ["notebook", "dashboard", GUEST, GUEST, GUEST, GUEST]


def test_one_without_a_key_is_not_heard_and_that_is_told_once(
    open_: Any, plain: Any, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(open_)
    for name in (b"series", b"another"):
        peer(plain, run.listening, name).send_multipart([b"", *wire.encode_request(Request(CLOCK_REQUEST))])
    series = run.client("series")
    series.send(wire.encode_request(Request(CLOCK_REQUEST, id="series/x/1")))
    assert [one.user for one in run.listening.until(1, PeerAsked, series)] == ["series"]
    deadline_s = time.monotonic() + 5.0
    while "its key is missing" not in caplog.text:
        assert time.monotonic() < deadline_s
        run.listening.router.receive()
    assert caplog.text.count("plain = true") == 1
