"""Peers of version 1 in an experiment of ours: plain sockets, and the golden bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import zmq
from bridged_fixtures import rig  # noqa: F401

from afspm import wire
from afspm.model import ControlRequest, ControlResponse, Region, ResponseDetail, Scan

GOLDEN = json.loads((Path(__file__).parents[3] / "proto" / "golden.json").read_text(encoding="utf-8"))
REQUESTS = {entry["name"]: [bytes.fromhex(frame) for frame in entry["frames"]] for entry in GOLDEN["requests"]}
REQUEST_CONTROL = [bytes([ControlRequest.REQUEST_CTRL]), b"\0"]
SUCCESS = bytes([ControlResponse.SUCCESS])


def published(by: str) -> list[tuple[str, list[bytes]]]:
    return [
        (entry["type"], [bytes.fromhex(frame) for frame in entry["frames"]])
        for entry in GOLDEN["published"]
        if entry["by"] == by and entry["type"] != "ControlState"  # which is the scheduler's own to say
    ]


def requester(rig: Any, plain: Any, name: str) -> Any:
    socket = plain(zmq.REQ)
    socket.setsockopt(zmq.ROUTING_ID, name.encode())
    socket.connect(rig.serve)
    return socket


def ask(rig: Any, socket: Any, frames: list[bytes]) -> list[bytes]:
    socket.send_multipart(frames)
    rig.until(lambda: socket.poll(0))
    answer: list[bytes] = socket.recv_multipart()
    return answer


def test_a_plain_component_takes_control_and_commands_with_the_golden_requests(rig: Any, plain: Any) -> None:
    rig.start()
    rig.linked(rig.component("Ours"))
    peer = requester(rig, plain, "Peer")
    forwarded = [frames for frames in REQUESTS.values() if frames[0][0] in (1, 2, 3, 4, 5, 12)]
    assert ask(rig, peer, REQUEST_CONTROL)[0] == SUCCESS
    for frames in forwarded:
        assert ask(rig, peer, frames)[0] == SUCCESS
    assert [(request.kind, request.payload) for request in rig.asked] == [(f[0][0], f[1]) for f in forwarded]


def test_a_restarted_plain_component_is_the_same_client(rig: Any, plain: Any) -> None:
    rig.start()
    rig.linked(rig.component("Ours"))
    first = requester(rig, plain, "Peer")
    assert ask(rig, first, REQUEST_CONTROL)[0] == SUCCESS
    first.close()
    again = requester(rig, plain, "Peer")
    assert ask(rig, again, REQUESTS["set feedback"])[0] == SUCCESS


def test_a_plain_subscriber_gets_the_cache_and_then_what_follows_in_the_golden_bytes(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    for (_, sent), (_, expected) in zip(published("translator"), published("scheduler"), strict=True):
        rig.publish_packet(sent[0].decode(), sent[1])
        rig.until(lambda expected=expected: ours.packets(expected[0].decode()))
    subscriber = plain(zmq.SUB)
    for prefix in (b"Scan2d", b"Spec1d", b"KILL"):
        subscriber.setsockopt(zmq.SUBSCRIBE, prefix)
    subscriber.connect(rig.publish)
    wanted = [frames[:2] for kind, frames in published("scheduler") if kind in ("Scan2d", "Spec1d")]
    assert [subscriber.recv_multipart()[:2] for _ in wanted] == wanted
    assert ours.ask(ControlRequest.END_EXPERIMENT).ok
    assert subscriber.recv_multipart() == [b"KILL"]


def test_a_plain_translator_is_asked_and_its_packets_pass(rig: Any, plain: Any) -> None:
    rig.translator.close()
    rig.translator = None
    publisher, server = plain(zmq.PUB), plain(zmq.REP)
    publisher.bind(rig.source[0])
    server.bind(rig.source[1])
    rig.start()
    component = rig.component("Component")

    def serve() -> Any:
        if server.poll(0):
            asked = server.recv_multipart()
            known = asked[0][0] in (1, 12) and b"scan" in asked[1]
            server.send(SUCCESS if known else bytes([ControlResponse.ACTION_NOT_SUPPORTED]))
        answer = component.answer_to(asked_for[-1])
        if answer is not None and answer.detail is ResponseDetail.NOT_SENT:  # the scheduler has not found it yet
            asked_for.append(component.send(ControlRequest.ACTION, "start-scan"))
            return None
        return answer

    assert component.ask(ControlRequest.REQUEST_CTRL, 0).ok
    asked_for = [component.send(ControlRequest.ACTION, "start-scan")]
    assert rig.until(serve).ok
    for (_, frames), (_, expected) in zip(published("translator"), published("scheduler"), strict=True):

        def arrived(frames: list[bytes] = frames, expected: list[bytes] = expected) -> Any:
            # the golden packets are all of one moment; a publisher's times increase
            publisher.send_multipart([*frames[:2], wire.encode_time(rig.clock.now_ns())])
            return (expected[0].decode(), expected[1]) in component.packets()

        rig.until(arrived)


def test_a_plain_scheduler_serves_our_component(rig: Any, plain: Any) -> None:
    publisher, router = plain(zmq.XPUB), plain(zmq.ROUTER)
    publisher.bind(rig.publish)
    router.bind(rig.serve)
    component = rig.component("Component")
    number = component.send(ControlRequest.REQUEST_CTRL, 0)
    rig.until(lambda: router.poll(0))
    assert router.recv_multipart() == [b"Component", b"", *REQUEST_CONTROL]
    router.send_multipart([b"Component", b"", SUCCESS])
    rig.until(lambda: component.answer_to(number))
    while publisher.recv() != b"\1":
        rig.pump()
    for _, packet in published("scheduler"):
        publisher.send_multipart(packet)
    expected = [(packet[0].decode(), packet[1]) for _, packet in published("scheduler")]
    rig.until(lambda: len(component.packets()) == len(expected))
    assert component.packets() == expected
    large = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.ones((512, 512)))  # 2 MiB in one frame
    publisher.send_multipart([b"Scan2d_1000.0_Height", wire.encode(large)[1]])
    rig.until(lambda: len(component.packets()) > len(expected))
    assert wire.decode("Scan2d", component.packets()[-1][1]).shape == (512, 512)
