"""Requests and their senders, and the order in which senders come and go."""

from __future__ import annotations

import logging
import socket
import time
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.model import CLOCK_REQUEST, Request, Response
from afspm.transport.keys import GUEST, Keys, pair
from afspm.transport.network import MAX_REQUEST_BYTES, Network
from afspm.transport.port import ControlConnected, ReplyReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected, Router
from afspm.transport.zmq_port import ZmqPort

CLOCK = ExperimentClock.real()


class Listening:
    """A router and all its events."""

    def __init__(self, open_: Any, own: Keys | None = None) -> None:
        self.network = open_(Network(own))
        log = RateLimitedLog(logging.getLogger("test"), CLOCK)
        self.router = Router(self.network, "tcp://127.0.0.1:0", log, CLOCK)
        self.told: list[Any] = []

    def until(self, count: int, kind: type = PeerAsked, *ports: ZmqPort) -> list[Any]:
        """Return the events of a kind once there are `count`, while polling `ports`."""
        deadline_s = time.monotonic() + DEADLINE_S
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


def test_req_and_dealer_peers_are_known_by_name_and_answered(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    for name, kind in ((b"Req", zmq.REQ), (b"Dealer", zmq.DEALER)):
        asking = peer(plain, listening, name, kind)
        asking.send_multipart([b"\7"] if kind == zmq.REQ else [b"", b"\7"])
        asked = listening.until(1)[-1]
        assert (asked.name, asked.frames, asked.user) == (name.decode(), [b"\7"], None)
        listening.router.reply(asked.connection, [b"\0"])
        assert asking.recv_multipart()[-1] == b"\0"
        listening.told.clear()


def test_connection_event_precedes_requests_and_its_end_follows(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    talking = peer(plain, listening, b"A")
    for n in range(100):
        talking.send_multipart([b"", b"%d" % n])
    talking.close(linger=1000)
    listening.until(1, PeerDisconnected)
    connection = listening.told[0].connection
    expected = [PeerAsked(connection, "A", None, [b"%d" % n]) for n in range(100)]
    assert listening.told == [PeerConnected(connection), *expected, PeerDisconnected(connection)]


def test_end_of_a_former_life_precedes_the_restarted_peer(open_: Any, plain: Any) -> None:
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


def test_end_of_a_req_socket_is_found_without_probes(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    asking, witness = peer(plain, listening, b"A", zmq.REQ), peer(plain, listening, b"B", zmq.REQ)
    asking.send(b"\7")
    (asked,) = listening.until(1)
    witness.send(b"\7")
    (_, other) = listening.until(2)
    asking.close(linger=0)
    assert listening.until(1, PeerDisconnected) == [PeerDisconnected(asked.connection)]
    for answer in (b"first", b"second", b"third"):
        listening.router.reply(other.connection, [answer])
        assert witness.recv() == answer
        listening.router._look_soon()
        witness.send(b"\7")
        other = listening.until(len(listening.until(0)) + 1)[-1]
    assert len(listening.until(1, PeerDisconnected)) == 1


def test_peers_without_a_name_have_none(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    for name in (b"", b"\xff\xfe"):
        peer(plain, listening, name).send_multipart([b"", b"\7"])
    assert [asked.name for asked in listening.until(2)] == ["", ""]


def test_malformed_request_is_dropped_and_the_next_is_received(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    talking = peer(plain, listening, b"A")
    for frames in ([b"x"], [b"x", b"", b"\7"], [b""], [b"", b"\7"]):
        talking.send_multipart(frames)
    assert [asked.frames for asked in listening.until(2)] == [[], [b"\7"]]


def test_a_message_that_is_too_large_ends_its_connection_and_nothing_else(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    other, large = peer(plain, listening, b"Other"), peer(plain, listening, b"Large")
    large.send_multipart([b"", b"\7"])
    (asked,) = listening.until(1)
    large.send_multipart([b"", bytes(MAX_REQUEST_BYTES + 1)])
    assert listening.until(1, PeerDisconnected) == [PeerDisconnected(asked.connection)]
    other.send_multipart([b"", b"\7"])
    assert [asked.name for asked in listening.until(2)] == ["Large", "Other"]


def test_peers_of_another_protocol_do_no_harm(open_: Any, plain: Any) -> None:
    listening = Listening(open_)
    port = int(listening.router.address.rpartition(":")[2])
    for sent in (b"", b"GET / HTTP/1.0\r\n\r\n", b"\x01\x00" * 100, b"\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL"):
        with socket.create_connection(("127.0.0.1", port)) as raw:
            raw.sendall(sent)
    peer(plain, listening, b"A").send_multipart([b"", b"\7"])
    assert [asked.name for asked in listening.until(1)] == ["A"]


def test_probe_disturbs_no_component(open_: Any, until: Any, caplog: pytest.LogCaptureFixture) -> None:
    listening = Listening(open_)
    found: list[Any] = []
    component = open_(ZmqPort(Network(), "A", CLOCK, control=listening.router.address))
    until(lambda: ControlConnected() in found, (component, found))
    component.send([b"\7", b"", b"A/first/1"])
    (asked,) = listening.until(1, PeerAsked, component)
    (identity,) = listening.router._senders
    listening.router.socket.send_multipart([identity, b""])
    listening.router.reply(asked.connection, wire.encode_response(Response(0, id="A/first/1")))
    until(lambda: any(isinstance(one, ReplyReceived) for one in found), (component, found))
    assert not caplog.records


class Run:
    """A router with keys made for a run, and its clients."""

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
        deadline_s = time.monotonic() + DEADLINE_S
        while ControlConnected() not in found:
            assert time.monotonic() < deadline_s
            found += port.poll(0.01)
            self.listening.told += self.listening.router.receive()
        return port


def answered(port: ZmqPort, within_s: float = DEADLINE_S) -> list[bytes]:
    """Return the payloads of the first answers."""
    found: list[Any] = []
    deadline_s = time.monotonic() + within_s
    while not found and time.monotonic() < deadline_s:
        found += [incoming for incoming in port.poll(0.05) if isinstance(incoming, ReplyReceived)]
    return [bytes(incoming.response.payload) for incoming in found]


def test_second_sender_of_a_name_gets_no_answers_of_the_first(open_: Any, plain: Any) -> None:
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
    assert answered(thief, 0.5) == []
    while bare.poll(100):
        assert bare.recv_multipart() == [b""]  # a look whether it is there


def test_identity_is_not_taken_over_by_another_key(open_: Any, plain: Any) -> None:
    # faults, mutant of router.py: the owner of the key was not compared
    run = Run(open_)
    heard = []
    for n, owner in enumerate(("series", "thief")):
        bare, own = plain(zmq.DEALER), run.keys(owner)
        bare.setsockopt(zmq.ROUTING_ID, b"series")
        bare.curve_publickey, bare.curve_secretkey = own.public, own.secret
        bare.curve_serverkey = own.server_key(run.listening.router.address)
        bare.connect(run.listening.router.address)
        bare.send_multipart([b"", *wire.encode_request(Request(CLOCK_REQUEST, id=f"series/{n}/1"))])
        heard.append(run.listening.until(n + 1)[-1])
    assert [one.user for one in heard] == ["series", "thief"]
    assert heard[0].connection != heard[1].connection


def test_restarted_sender_has_its_name_while_its_old_connection_stands(open_: Any) -> None:
    run = Run(open_)
    for life in range(2):
        port = run.client("series")
        port.send(wire.encode_request(Request(CLOCK_REQUEST, id=f"series/{life}/1")))
        asked = run.listening.until(life + 1, PeerAsked, port)[-1]
    assert (asked.name, asked.user) == ("series", "series")
    run.listening.router.reply(asked.connection, wire.encode_response(Response(0, b"anew", id="series/1/1")))
    assert answered(port) == [b"anew"]


def test_second_process_of_a_name_does_not_take_answers(open_: Any) -> None:
    run = Run(open_)
    first = run.client(GUEST, "notebook")
    first.send(wire.encode_request(Request(CLOCK_REQUEST, id="notebook/first/1")))
    (one,) = run.listening.until(1, PeerAsked, first)
    run.listening.router.reply(one.connection, wire.encode_response(Response(0, b"first", id="notebook/first/1")))
    assert answered(first) == [b"first"]
    second = run.client(GUEST, "notebook")
    second.send(wire.encode_request(Request(CLOCK_REQUEST, id="notebook/second/1")))
    other = run.listening.until(2, PeerAsked, second)[-1]
    assert other.connection != one.connection
    run.listening.router.reply(other.connection, wire.encode_response(Response(1, b"no", id="notebook/second/1")))
    assert answered(second) == [b"no"]
    first.send(wire.encode_request(Request(CLOCK_REQUEST, id="notebook/first/2")))
    asked = run.listening.until(3, PeerAsked, first)[-1]
    assert asked.connection == one.connection
    run.listening.router.reply(asked.connection, wire.encode_response(Response(0, b"again", id="notebook/first/2")))
    assert answered(first) == [b"again"]
    assert not [event for event in run.listening.told if isinstance(event, PeerDisconnected)]


def test_restarted_peer_is_reported_after_the_end_of_its_former_life(open_: Any) -> None:
    run = Run(open_)
    for life in range(5):
        port = run.client("series")
        port.send(wire.encode_request(Request(CLOCK_REQUEST, id=f"series/{life}/1")))
        run.listening.until(life + 1, PeerAsked, port)
        port.close()  # and the next life begins before the router has looked
    expected = [PeerConnected, PeerAsked, PeerDisconnected] * 5
    assert [type(event) for event in run.listening.told][: len(expected) - 1] == expected[:-1]


def test_guest_may_not_take_the_name_of_a_process(open_: Any) -> None:
    run = Run(open_)
    heard = []
    for n, name in enumerate(("notebook", "dashboard:Ada", "series", "series:Ada", "scheduler", GUEST)):
        client = run.client(GUEST, name)
        client.send(wire.encode_request(Request(CLOCK_REQUEST, id="x")))
        heard.append(run.listening.until(n + 1, PeerAsked, client)[-1].user)
    assert heard == ["notebook", "dashboard", GUEST, GUEST, GUEST, GUEST]


# faults 8
def test_cut_handshake_is_not_reported_as_a_wrong_key(open_: Any, plain: Any, caplog: pytest.LogCaptureFixture) -> None:
    run = Run(open_)
    router = run.listening.router

    def until_logged(text: str) -> None:
        deadline_s = time.monotonic() + DEADLINE_S
        while text not in caplog.text:
            assert time.monotonic() < deadline_s, caplog.text
            router.receive()

    host, _, port = router.address.removeprefix("tcp://").rpartition(":")
    with socket.create_connection((host, int(port))) as link:
        link.sendall(b"\xff")  # the first byte of the greeting
        link.recv(1)
    until_logged("the link was cut")
    assert "insecure" not in caplog.text
    # the first cut hides no refusal after it
    stranger = plain(zmq.DEALER)
    stranger.curve_publickey, stranger.curve_secretkey = zmq.curve_keypair()
    stranger.curve_serverkey = run.pairs["scheduler"][0]
    stranger.connect(router.address)
    until_logged("not among the public keys")


def test_peer_without_a_key_is_refused_and_logged_once(
    open_: Any, plain: Any, caplog: pytest.LogCaptureFixture
) -> None:
    run = Run(open_)
    for name in (b"series", b"another"):
        peer(plain, run.listening, name).send_multipart([b"", *wire.encode_request(Request(CLOCK_REQUEST))])
    series = run.client("series")
    series.send(wire.encode_request(Request(CLOCK_REQUEST, id="series/x/1")))
    assert [one.user for one in run.listening.until(1, PeerAsked, series)] == ["series"]
    deadline_s = time.monotonic() + DEADLINE_S
    # the peer may hang up before the router has seen that it has no key
    while "it has no key" not in caplog.text and "without keys gave up" not in caplog.text:
        assert time.monotonic() < deadline_s
        run.listening.router.receive()
    assert caplog.text.count("insecure = true") <= 1
