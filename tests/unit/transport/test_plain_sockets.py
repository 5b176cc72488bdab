"""Programs of other makes in every role, as plain sockets with the golden bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zmq

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.transport.network import Network
from afspm.transport.port import CaughtUp, ControlConnected, Killed, PacketReceived, ReplyReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()


GOLDEN = json.loads((Path(__file__).parents[3] / "proto" / "golden.json").read_text(encoding="utf-8"))
REQUESTS = [[bytes.fromhex(frame) for frame in entry["frames"]] for entry in GOLDEN["requests"]]
RESPONSES = [[bytes.fromhex(frame) for frame in entry["frames"]] for entry in GOLDEN["responses"]]
PACKETS = [[bytes.fromhex(frame) for frame in entry["frames"]] for entry in GOLDEN["published"]]


def random_port(socket: Any) -> str:
    return f"tcp://127.0.0.1:{socket.bind_to_random_port('tcp://127.0.0.1')}"


def test_plain_req_socket_gets_answers_of_the_server(open_: Any, plain: Any, until: Any) -> None:
    server, requester = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=None)), plain(zmq.REQ)
    requester.connect(server.serve_address)
    for request, response in zip(REQUESTS, RESPONSES * len(REQUESTS), strict=False):
        asked: list[Any] = []
        requester.send_multipart(request)
        until(lambda asked=asked: asked, (server, asked))
        assert asked[0].frames == request
        server.reply(response)
        assert requester.recv_multipart() == response


@pytest.mark.parametrize("is_busy", [False, True])
def test_waiting_request_is_seen_before_its_turn_and_answered_in_it(
    open_: Any, plain: Any, until: Any, is_busy: bool
) -> None:
    server = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=None))
    first, second = plain(zmq.REQ), plain(zmq.REQ)
    asked: list[Any] = []
    for one in (first, second):
        one.connect(server.serve_address)
    if is_busy:
        first.send_multipart(REQUESTS[0])
        until(lambda: asked, (server, asked))
    second.send_multipart(REQUESTS[1])
    until(lambda: server.waiting_request() is not None)
    assert server.waiting_request().frames == REQUESTS[1]
    if is_busy:
        assert server.poll(0.0) == [], "one request is being answered"
        server.reply(RESPONSES[0])
        assert first.recv_multipart() == RESPONSES[0]
    (request,) = server.poll(0.0)
    assert request.frames == REQUESTS[1]
    assert server.waiting_request() is None
    server.reply(RESPONSES[1])
    assert second.recv_multipart() == RESPONSES[1]


def test_newest_connection_of_a_name_is_served(open_: Any, plain: Any, until: Any) -> None:
    server = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=None))
    for _ in range(3):  # of which none is closed: who crashed with its computer is not found dead for seconds
        requester = plain(zmq.REQ)
        asked: list[Any] = []
        requester.setsockopt(zmq.ROUTING_ID, b"scheduler")
        requester.connect(server.serve_address)
        requester.send_multipart(REQUESTS[0])
        until(lambda asked=asked: asked, (server, asked))
        server.reply(RESPONSES[0])
        assert requester.recv_multipart() == RESPONSES[0]


def test_component_gets_answers_of_a_plain_router(open_: Any, plain: Any, until: Any) -> None:
    router = plain(zmq.ROUTER)
    found: list[Any] = []
    port = open_(ZmqPort(Network(), "Component", CLOCK, control=random_port(router)))
    until(lambda: ControlConnected() in found, (port, found))
    for number, (request, response) in enumerate(zip(REQUESTS, RESPONSES * len(REQUESTS), strict=False)):
        found.clear()
        sent = [*[*request, b""][:2], b"Component/session/%d" % number]
        port.send(sent)
        identity, *received = router.recv_multipart()
        assert (identity.partition(b"\0")[0], received) == (b"Component", [b"", *sent])
        router.send_multipart([identity, b"", *response])
        until(lambda: found, (port, found))
        assert found == [ReplyReceived(wire.decode_response(response))]


def test_component_sends_nothing_to_a_router_before_its_first_request(open_: Any, plain: Any, until: Any) -> None:
    router = plain(zmq.ROUTER)
    found: list[Any] = []
    port = open_(ZmqPort(Network(), "Component", CLOCK, control=random_port(router)))
    until(lambda: ControlConnected() in found, (port, found))
    assert not router.poll(50)


@pytest.mark.parametrize("with_time", [True, False])
def test_component_subscribes_to_a_plain_pub(open_: Any, plain: Any, until: Any, with_time: bool) -> None:
    publisher = plain(zmq.XPUB)
    found: list[Any] = []
    port = open_(ZmqPort(Network(), "Component", CLOCK, subscribe=[random_port(publisher)], envelopes=["Scan2d"]))
    seen = set()
    while b"\1Scan2d" not in seen:  # the plain prefix, beside a marker that means nothing to this peer
        port.poll(0.0)
        seen.add(publisher.recv())
    for frames in PACKETS:
        publisher.send_multipart(frames if with_time else frames[:2])
    publisher.send(b"KILL")
    until(lambda: Killed() in found, (port, found))
    got = [[i.packet.envelope.encode(), bytes(i.packet.payload)] for i in found if isinstance(i, PacketReceived)]
    assert got == [frames[:2] for frames in PACKETS if frames[0].startswith(b"Scan2d")]
    assert not any(isinstance(incoming, CaughtUp) for incoming in found)


def test_component_drops_repeated_packets_of_a_plain_pub(open_: Any, plain: Any, until: Any) -> None:
    publisher = plain(zmq.XPUB)
    found: list[Any] = []
    port = open_(ZmqPort(Network(), "Component", CLOCK, subscribe=[random_port(publisher)]))
    while publisher.recv() != b"\1":
        port.poll(0.0)
    for _ in range(3):
        for frames in PACKETS:
            publisher.send_multipart(frames)
    publisher.send(b"KILL")
    until(lambda: Killed() in found, (port, found))
    envelopes = [i.packet.envelope.encode() for i in found if isinstance(i, PacketReceived)]
    assert envelopes == list(dict.fromkeys(envelopes))


@pytest.mark.parametrize("prefix", [b"", b"Scan2d"])
def test_plain_sub_gets_earlier_packets_oldest_first_then_live_ones(
    open_: Any, plain: Any, until: Any, prefix: bytes
) -> None:
    publisher, subscriber = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=ANY)), plain(zmq.SUB)
    for n in range(10):
        publisher.publish(f"Scan2d_{n % 2}", b"%d" % n)
    subscriber.setsockopt(zmq.SUBSCRIBE, prefix)
    subscriber.setsockopt(zmq.SUBSCRIBE, b"KILL")
    subscriber.connect(publisher.publish_address)
    until(lambda: subscriber.poll(0), (publisher, []))
    publisher.publish("Scan2d_0", b"live")
    publisher.kill()
    got = []
    while (frames := subscriber.recv_multipart()) != [b"KILL"]:
        got.append(frames)
    assert [payload for _, payload, _ in got] == [b"%d" % n for n in range(10)] + [b"live"]
    received = [wire.decode_packet(frames).time_ns for frames in got]
    times = [time_ns for time_ns in received if time_ns is not None]
    assert len(times) == len(received)
    assert times == sorted(set(times))


def test_plain_sub_to_everything_does_not_see_another_replay(open_: Any, plain: Any, until: Any) -> None:
    publisher, subscriber = open_(ZmqServerPort(Network(), CLOCK, serve=ANY, publish=ANY)), plain(zmq.SUB)
    subscriber.setsockopt(zmq.SUBSCRIBE, b"")
    subscriber.connect(publisher.publish_address)
    joined: list[Any] = []
    until(lambda: joined, (publisher, joined))
    publisher.publish("Scan2d", b"one")
    found: list[Any] = []
    late = open_(ZmqPort(Network(), "Late", CLOCK, subscribe=[publisher.publish_address]))
    until(lambda: any(isinstance(i, CaughtUp) for i in found), (publisher, []), (late, found))
    publisher.kill()
    got = []
    while (frames := subscriber.recv_multipart()) != [b"KILL"]:
        got.append(frames[:2])
    assert got == [[b"Scan2d", b"one"]]
