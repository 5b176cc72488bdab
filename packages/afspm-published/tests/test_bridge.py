"""The bridge itself, between programs of the published implementation and ours."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from bridged_fixtures import rig  # noqa: F401
from bridged_rig import BridgedRig
from version_1 import REQUEST, Client, Subscriber

from afspm import wire
from afspm.basics.launch import Sockets
from afspm.model import ControlRequest, ControlResponse, Region, Request, Response, Scan, ScopeState, ScopeStatus
from afspm.supervisor.ports import FreePorts
from afspm.transport import keys
from afspm.wire.generated import control_pb2, scan_pb2

SUCCESS = int(ControlResponse.SUCCESS)
PAUSE_S = 0.4
SCAN = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((2, 2)), 1)
START = control_pb2.ActionMsg(action="start-scan")


def client(rig: BridgedRig, plain: Any, name: str, address: str = "") -> Any:
    made = Client(plain(zmq.REQ), address or rig.serve, name)

    def ask(number: int, thing: Any = None) -> int:
        made.send(number, thing)
        rig.until(made.has_answer)
        return made.answer()

    return ask


def bare_translator(rig: BridgedRig, plain: Any) -> tuple[Any, Any]:
    """Start the rig with sockets in place of its translator; return those for requests and for packets."""
    assert rig.translator is not None
    rig.translator.close()
    rig.translator = None
    server, publisher = plain(zmq.REP), plain(zmq.PUB)
    server.bind(rig.source[1])
    publisher.bind(rig.source[0])
    rig.start()
    return server, publisher


def test_channels_of_a_scan_arrive_a_poll_apart_and_a_move_lasts_one(rig: BridgedRig, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    theirs = Subscriber(plain(zmq.SUB), rig.publish)
    rig.peers.append(theirs)
    rig.until(lambda: theirs.cache)
    sent_s = time.monotonic()
    for channel in ("Height", "Phase"):
        rig.publish_packet(*wire.encode(Scan(SCAN.region, channel, "m", SCAN.values, 1)))
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.MOVING)))
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.FREE)))
    arrived_s: dict[str, float] = {}
    for name, is_there in (
        ("Height", lambda: "Scan2d_1000.0_Height" in theirs.cache),
        ("Phase", lambda: "Scan2d_1000.0_Phase" in theirs.cache),
        ("moving", lambda: theirs.state == ScopeState.MOVING),
        ("free", lambda: theirs.state == ScopeState.FREE),
    ):
        rig.until(is_there)
        arrived_s[name] = time.monotonic()
    # on a busy computer an arrival is noticed late, but never early
    assert arrived_s["Phase"] - sent_s > PAUSE_S * 0.8
    assert arrived_s["free"] - sent_s > 2 * PAUSE_S * 0.8


def test_a_late_peer_receives_the_last_packet_of_each_envelope(rig: BridgedRig, plain: Any) -> None:
    rig.start()
    rig.linked(rig.component("Ours"))
    early = Subscriber(plain(zmq.SUB), rig.publish)
    rig.peers.append(early)
    rig.until(lambda: early.cache)
    for size_m in (1e-6, 2e-6):
        for value in (1.0, 2.0):
            region = Region((0.0, 0.0), (size_m, size_m))
            rig.publish_packet(*wire.encode(Scan(region, "Height", "m", np.full((2, 2), value), 1)))
    newest = scan_pb2.Scan2d(values=[2.0] * 4)
    rig.until(lambda: getattr(early.cache.get("Scan2d_2000.0_Height"), "values", []) == newest.values)
    late = plain(zmq.SUB)
    late.setsockopt(zmq.SUBSCRIBE, b"Scan2d")
    late.connect(rig.publish)
    rig.until(lambda: late.poll(0))
    arrived = [late.recv_multipart()[0]]
    while len(arrived) < 2 or late.poll(int(2e3 * PAUSE_S)):
        arrived.append(late.recv_multipart()[0])
    assert arrived == [b"Scan2d_1000.0_Height", b"Scan2d_2000.0_Height"]


def test_flagging_and_clearing_no_problem_is_a_success(rig: BridgedRig, plain: Any) -> None:
    rig.start()
    rig.linked(rig.component("Ours"))
    ask = client(rig, plain, "Theirs")
    assert [ask(ControlRequest.ADD_EXP_PRBLM, 0), ask(ControlRequest.RMV_EXP_PRBLM, 0)] == [SUCCESS, SUCCESS]


def test_a_peer_that_is_gone_gives_control_back(rig: BridgedRig, plain: Any) -> None:
    rig.settings = {"control": {"grace_s": 0.1}}
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    socket = plain(zmq.REQ)
    socket.setsockopt(zmq.ROUTING_ID, b"Theirs")
    socket.connect(rig.serve)
    socket.send_multipart([bytes([REQUEST]), b"\0"])
    rig.until(lambda: socket.poll(0))
    assert socket.recv()[0] == SUCCESS
    assert not ours.ask(ControlRequest.REQUEST_CTRL, 0).ok
    socket.close()
    rig.until(lambda: ours.ask(ControlRequest.REQUEST_CTRL, 0).ok)


def test_their_scheduler_finds_our_microscope_where_a_translator_of_theirs_would_be(
    rig: BridgedRig, plain: Any
) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    ports = FreePorts()
    serve, publish = ports.address(), ports.address()
    sockets = Sockets(subscribe=(str(rig.inside.publish),), control=rig.inside.serve)
    rig.bridge("peers.PublishedPeers", sockets, serve=serve, publish=publish, as_translator=True)
    theirs = Subscriber(plain(zmq.SUB), publish)
    rig.peers.append(theirs)
    ask = client(rig, plain, "", serve)
    assert ask(ControlRequest.ACTION, START) == SUCCESS
    assert [request.subject for request in rig.asked] == ["start-scan"]
    assert ask(REQUEST, 0) == ControlResponse.CMD_NOT_SUPPORTED
    rig.publish_packet(*wire.encode(SCAN))
    rig.until(lambda: "Scan2d" in theirs.cache)
    assert set(theirs.cache) == {"Scan2d"}


def test_a_request_that_their_translator_may_have_carried_out_is_not_sent_again(rig: BridgedRig, plain: Any) -> None:
    server, _ = bare_translator(rig, plain)
    ours = rig.component("Ours")
    answers = {12: b"\0"}  # it answers whether it has an action, and is silent where it is to do it
    asked: list[int] = []

    def pump() -> None:
        if server.poll(0):
            asked.append(server.recv_multipart()[0][0])
            if (answer := answers.get(asked[-1])) is not None:
                server.send(answer)

    rig.peers.append(type("Pumped", (), {"pump": staticmethod(pump)}))
    rig.until(lambda: ours.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok)
    assert ours.ask(ControlRequest.REQUEST_CTRL, 0).ok
    request_id = ours.send(ControlRequest.ACTION, "start-scan")
    rig.until(lambda: ControlRequest.ACTION in asked)
    bridge = rig.bridges[-1]
    bridge.process.kill()
    bridge.close()
    rig.until(lambda: ours.answer_to(request_id))
    server.send(b"\0")  # to nobody
    sockets = Sockets(publish=rig.inside.subscribe[0], serve=rig.inside.control)
    rig.bridge("translator.PublishedTranslator", sockets, serve=rig.source[1], publish=rig.source[0])
    rig.until(lambda: ours.ask(ControlRequest.ACTION_SUPPORT, "stop-scan").ok)
    again = ours.ask(ControlRequest.ACTION, "start-scan", key=request_id)
    assert again.code == ControlResponse.NO_RESPONSE
    assert asked.count(ControlRequest.ACTION) == 1


def test_a_large_scan_of_their_translator_arrives(rig: BridgedRig, plain: Any) -> None:
    _, publisher = bare_translator(rig, plain)
    ours = rig.component("Ours")
    large = Scan(SCAN.region, "Height", "m", np.ones((512, 512)), 1)  # 2 MiB in one frame
    ready = wire.encode(ScopeStatus(ScopeState.FREE))
    # a subscriber that has just connected misses packets
    rig.until(lambda: publisher.send_multipart([ready[0].encode(), ready[1]]) or ours.packets("ScopeStateMsg"))
    publisher.send_multipart([b"Scan2d", wire.encode(large)[1]])
    rig.until(lambda: ours.packets("Scan2d"))
    ((_, payload),) = ours.packets("Scan2d")
    assert wire.decode("Scan2d", payload).shape == (512, 512)


def test_file_says_what_the_channels_of_their_translator_measure(rig: BridgedRig, plain: Any) -> None:
    rig.translator_settings = {"channels": {"height": "HeightTrace"}}
    bare_translator(rig, plain)
    ours = rig.component("Ours")
    rig.until(lambda: ours.packets("ChannelRoles"))
    roles = wire.decode("ChannelRoles", ours.packets("ChannelRoles")[-1][1])
    assert roles.of("HeightTrace") == ("height", "topography")


@pytest.fixture
def locked_rig(tmp_path: Path) -> Iterator[BridgedRig]:
    keys.generate(tmp_path / "keys", ["scheduler", "translator", "Experiment", "bridge"])
    made = BridgedRig(tmp_path, tmp_path / "keys")
    yield made
    made.close()


def test_with_keys_the_bridge_acts_for_its_peers_with_its_own(locked_rig: BridgedRig, plain: Any) -> None:
    rig = locked_rig
    rig.start()
    ours = rig.component("Experiment")
    rig.linked(ours)
    theirs = Subscriber(plain(zmq.SUB), rig.publish)
    rig.peers.append(theirs)
    ask = client(rig, plain, "Theirs")
    assert ask(REQUEST, 0) == SUCCESS
    rig.until(lambda: getattr(theirs.cache.get("ControlState"), "client_in_control_id", "") == "Theirs")
    told = [wire.decode("ControlState", payload).holder for _, payload in ours.packets("ControlState")]
    rig.until(lambda: ours.packets("ControlState"))
    assert told[-1] == "bridge:Theirs"
    rig.answer = lambda request: Response(0, id=request.id)
    assert ask(ControlRequest.ACTION, START) == SUCCESS
    assert [(request.kind, request.subject) for request in rig.asked] == [(1, "start-scan")]
    assert isinstance(rig.asked[0], Request)
