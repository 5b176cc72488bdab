"""Ports of components and translators against each other."""

from __future__ import annotations

import threading
from typing import Any

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.transport.network import Network
from afspm.transport.port import (
    CaughtUp,
    ControlConnected,
    ControlDisconnected,
    Killed,
    PacketReceived,
    ParentGone,
    ReplyReceived,
    RequestReceived,
)
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

ANY = "tcp://127.0.0.1:0"
CLOCK = ExperimentClock.real()


def server(address: str = ANY, publish: str | None = ANY) -> ZmqServerPort:
    return ZmqServerPort(Network(), CLOCK, serve=address, publish=publish)


def component(name: str = "Component", **where: Any) -> ZmqPort:
    return ZmqPort(Network(), name, CLOCK, **where)


def payloads(found: list[Any]) -> list[bytes]:
    return [bytes(incoming.packet.payload) for incoming in found if isinstance(incoming, PacketReceived)]


def kinds(found: list[Any]) -> set[type]:
    return {type(incoming) for incoming in found}


def test_late_joiner_gets_earlier_packets_in_order_then_live_ones(open_: Any, until: Any) -> None:
    publisher = open_(server())
    found: list[Any] = []
    for n in range(20):
        publisher.publish(f"Scan2d_{n % 3}", b"%d" % n)
    late = open_(component(subscribe=[publisher.publish_address]))
    until(lambda: CaughtUp in kinds(found), (publisher, []), (late, found))
    publisher.publish("Other", b"live")
    until(lambda: b"live" in payloads(found), (publisher, []), (late, found))
    assert payloads(found) == [b"%d" % n for n in range(20)] + [b"live"]


def test_replay_reaches_only_the_late_joiner(open_: Any, until: Any) -> None:
    publisher = open_(server())
    early_found: list[Any] = []
    late_found: list[Any] = []
    early = open_(component("Early", subscribe=[publisher.publish_address]))
    until(lambda: CaughtUp in kinds(early_found), (publisher, []), (early, early_found))
    publisher.publish("Scan2d", b"one")
    late = open_(component("Late", subscribe=[publisher.publish_address]))
    until(lambda: CaughtUp in kinds(late_found), (publisher, []), (late, late_found), (early, early_found))
    publisher.publish("Scan2d", b"two")
    until(
        lambda: b"two" in payloads(late_found) and b"two" in payloads(early_found),
        (publisher, []), (late, late_found), (early, early_found),
    )  # fmt: skip
    assert payloads(early_found) == payloads(late_found) == [b"one", b"two"]


def test_two_subscribers_to_everything_do_not_see_each_others_replay(open_: Any, until: Any) -> None:
    publisher = open_(server())
    publisher.publish("Scan2d", b"one")
    ports = [open_(component(f"C{n}", subscribe=[publisher.publish_address])) for n in range(4)]
    found: list[list[Any]] = [[] for _ in ports]
    until(lambda: all(CaughtUp in kinds(f) for f in found), (publisher, []), *zip(ports, found, strict=True))
    assert [payloads(f) for f in found] == [[b"one"]] * 4


def test_only_subscribed_envelopes_arrive(open_: Any, until: Any) -> None:
    publisher = open_(server())
    found: list[Any] = []
    publisher.publish("Scan2d_5.0_Height", b"scan")
    publisher.publish("ScopeStateMsg", b"state")
    port = open_(component(subscribe=[publisher.publish_address], envelopes=["Scan2d", "Spec1d"]))
    until(lambda: CaughtUp in kinds(found), (publisher, []), (port, found))
    publisher.publish("ScopeStateMsg", b"state")
    publisher.publish("Spec1d_IV", b"spectrum")
    until(lambda: b"spectrum" in payloads(found), (publisher, []), (port, found))
    assert payloads(found) == [b"scan", b"spectrum"]


def test_restarted_publisher_is_found_and_packets_do_not_come_twice(open_: Any, until: Any) -> None:
    publisher = server()
    found: list[Any] = []
    address = publisher.publish_address
    port = open_(component(subscribe=[address]))
    until(lambda: CaughtUp in kinds(found), (publisher, []), (port, found))
    first_ns = CLOCK.now_ns()
    publisher.publish("Scan2d", b"one", first_ns)
    until(lambda: b"one" in payloads(found), (publisher, []), (port, found))
    publisher.close()
    publisher = open_(server(publish=address))
    publisher.publish("Scan2d", b"one", first_ns)
    publisher.publish("Scan2d", b"missed", first_ns + 10)
    found.clear()
    until(lambda: CaughtUp in kinds(found), (publisher, []), (port, found))
    assert payloads(found) == [b"missed"]


def test_large_payloads_arrive_whole_and_are_not_copied(open_: Any, until: Any) -> None:
    publisher = open_(server())
    found: list[Any] = []
    large = bytes(range(256)) * 4096
    port = open_(component(subscribe=[publisher.publish_address]))
    until(lambda: CaughtUp in kinds(found), (publisher, []), (port, found))
    publisher.publish("Scan2d", large)
    until(lambda: len(payloads(found)) == 1, (publisher, []), (port, found))
    payload = next(i.packet.payload for i in found if isinstance(i, PacketReceived))
    assert isinstance(payload, memoryview)
    assert payload.readonly
    assert payload == large


def test_kill_reaches_a_component_that_subscribes_to_something_else(open_: Any, until: Any) -> None:
    publisher = open_(server())
    found: list[Any] = []
    port = open_(component(subscribe=[publisher.publish_address], envelopes=["Scan2d"]))
    until(lambda: CaughtUp in kinds(found), (publisher, []), (port, found))
    publisher.kill()
    until(lambda: Killed in kinds(found), (port, found))


def test_a_component_publishes_to_others(open_: Any, until: Any) -> None:
    first = open_(component("First", publish=ANY))
    found: list[Any] = []
    first.publish("Score", b"0.5")
    second = open_(component("Second", subscribe=[first.publish_address]))
    until(lambda: CaughtUp in kinds(found), (first, []), (second, found))
    assert payloads(found) == [b"0.5"]
    with pytest.raises(ConfigError, match="no address to publish on"):
        second.publish("Score", b"")


def test_request_is_answered_and_connections_of_the_server_are_events(open_: Any, until: Any) -> None:
    translator = server()
    found: list[Any] = []
    asked: list[Any] = []
    address = translator.serve_address
    port = open_(component(control=address))
    until(lambda: ControlConnected in kinds(found), (port, found))
    port.send([b"\1", b"object", b"id-1"])
    until(lambda: asked, (translator, asked), (port, found))
    assert asked == [RequestReceived([b"\1", b"object", b"id-1"])]
    translator.reply([b"\0", b"", b"", b"id-1"])
    until(lambda: ReplyReceived in kinds(found), (port, found))
    translator.close()
    found.clear()
    until(lambda: ControlDisconnected in kinds(found), (port, found))
    port.send([b"\1", b"nobody hears this", b"id-2"])
    translator = open_(server(address))
    found.clear()
    until(lambda: ControlConnected in kinds(found), (translator, asked), (port, found))
    port.send([b"\1", b"object", b"id-3"])
    until(lambda: len(asked) > 1, (translator, asked), (port, found))
    assert [a.frames for a in asked if a.frames][-1] == [b"\1", b"object", b"id-3"]


def test_a_server_takes_one_request_at_a_time_and_may_leave_one_unanswered(open_: Any, until: Any) -> None:
    translator = open_(server())
    asked: list[Any] = []
    found: list[Any] = []
    port = open_(component(control=translator.serve_address))
    until(lambda: ControlConnected in kinds(found), (port, found))
    for n in range(3):
        port.send([b"\1", b"%d" % n, b""])
    until(lambda: asked, (translator, asked), (port, found))
    assert len(asked) == 1
    assert translator.poll(0.0) == []
    translator.reply(None)
    until(lambda: len(asked) == 2, (translator, asked))
    translator.reply([b"\0", b"second"])
    until(lambda: ReplyReceived in kinds(found), (translator, asked), (port, found))
    replies = [incoming.response.payload for incoming in found if isinstance(incoming, ReplyReceived)]
    assert replies == [b"second"]


def test_another_thread_ends_a_wait_with_an_event(open_: Any) -> None:
    port = open_(component())
    threading.Timer(0.05, lambda: port.wake_up(ParentGone())).start()
    assert port.poll(None) == [ParentGone()]


def test_closing_without_a_peer_does_not_wait_for_one() -> None:
    publisher = server()
    ports = [component(f"C{n}", subscribe=[publisher.publish_address], control=ANY[:-1] + "1") for n in range(3)]
    for port in ports:
        port.send([b"\1"])
    publisher.publish("Scan2d", bytes(10_000_000))
    for close in (*(port.close for port in ports), publisher.close):
        close()
        close()
