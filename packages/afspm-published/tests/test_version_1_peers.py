"""Peers of version 1 that end over whatever their version does not have, in an experiment of ours."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zmq
from bridged_fixtures import rig, router  # noqa: F401
from deadlines import DEADLINE_S
from version_1 import END, PARAM, RELEASE, REQUEST, Client, Router, Server, Subscriber

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.client.experiment_link import ExperimentLink
from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    LogLine,
    Note,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Region,
    RelayedMessage,
    Response,
    ScanLines,
    ScopeState,
    ScopeStatus,
)
from afspm.model.events import LogLines
from afspm.supervisor import run_identity
from afspm.supervisor.reporter import Reporter, ReportFailed
from afspm.transport.network import Network
from afspm.transport.port import Killed
from afspm.transport.zmq_port import ZmqPort
from afspm.wire.generated import control_pb2, feedback_pb2, scan_pb2, spectroscopy_pb2

CLOCK = ExperimentClock.real()
SUCCESS, NOT_IN_CONTROL = int(ControlResponse.SUCCESS), int(ControlResponse.NOT_IN_CONTROL)
SCANNING, FREE = 2, 3


def until(condition: Any, *pumped: Any) -> Any:
    deadline_s = time.monotonic() + DEADLINE_S
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "it did not happen in time"
        for one in pumped:
            one()
    return value


# --- their components beside our scheduler ---


def subscriber(rig: Any, plain: Any, *prefixes: bytes) -> Subscriber:
    made = Subscriber(plain(zmq.SUB), rig.publish, *prefixes)
    rig.peers.append(made)
    return made


def client(rig: Any, plain: Any, name: str) -> Any:
    """Returns what asks as a client of version 1, and awaits the answer."""
    made = Client(plain(zmq.REQ), rig.serve, name)

    def ask(number: int, thing: Any = None) -> int:
        made.send(number, thing)
        rig.until(made.has_answer)
        return made.answer()

    return ask


def say_everything_of_ours(rig: Any, ours: Any) -> None:
    """Have the scheduler publish a message of every kind that version 1 does not know."""
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    one = ProcessState("one", "component", ProcessCondition.ALIVE, CLOCK.now_ns())
    rig.publish_packet(*wire.encode(ScanLines(region, (1, 2), "Height", "m", 0, np.zeros((1, 2)), CLOCK.now_ns())))
    for thing in (
        LogLines((LogLine(CLOCK.now_ns(), "one", "INFO", "a line"),)),
        ProcessStates(CLOCK.now_ns(), "here", (one,)),
        Note(CLOCK.now_ns(), "Ours", "a note"),
    ):
        assert ours.ask(RELAY_REQUEST, RelayedMessage(*wire.encode(thing))).ok
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.SCANNING)))
    rig.until(lambda: all(ours.packets(name) for name in ("JournalEntries", "LogLines", "ProcessStates", "ScanLines")))


def test_a_subscriber_to_all_is_sent_what_version_1_has(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    early = subscriber(rig, plain)
    rig.until(lambda: early.cache)
    say_everything_of_ours(rig, ours)
    late = subscriber(rig, plain)
    for one in (early, late):
        rig.until(lambda one=one: one.state == SCANNING)
        assert set(one.cache) == {"ControlState", "ScopeStateMsg"}
    assert ours.ask(ControlRequest.END_EXPERIMENT).ok
    rig.until(lambda: early.killed and late.killed)


def test_who_names_an_envelope_of_ours_is_sent_that(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    say_everything_of_ours(rig, ours)
    listener = plain(zmq.SUB)
    listener.setsockopt(zmq.SUBSCRIBE, b"LogLines")
    listener.connect(rig.publish)
    rig.until(lambda: listener.poll(0))
    assert listener.recv_multipart()[0] == b"LogLines"


def test_a_client_is_answered_in_the_frames_of_version_1(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    ask = client(rig, plain, "Theirs")
    rig.answer = lambda request: Response(8, reason="there is no such parameter", id=request.id)
    unknown = control_pb2.ParameterMsg(parameter="x-unknown")
    assert ask(PARAM, control_pb2.ParameterMsg(parameter="x-unknown", value="1")) == NOT_IN_CONTROL
    assert ask(PARAM, unknown) == 8
    assert ask(1, control_pb2.ActionMsg(action="start-scan")) == NOT_IN_CONTROL
    assert [ask(RELEASE), ask(REQUEST, 0), ask(RELEASE)] == [NOT_IN_CONTROL, SUCCESS, SUCCESS]
    assert ask(3, scan_pb2.ScanParameters2d()) == NOT_IN_CONTROL


@pytest.mark.parametrize("name", ["", "Ours"])
def test_peer_without_a_role_gets_the_reason_in_the_answer(rig: Any, plain: Any, name: str) -> None:
    rig.start()
    rig.linked(rig.component("Ours"))
    asking = plain(zmq.REQ)
    if name:
        asking.setsockopt(zmq.ROUTING_ID, name.encode())
    asking.connect(rig.serve)
    asking.send_multipart([bytes([REQUEST]), b"\0"])
    rig.until(lambda: asking.poll(0))
    code, _, reason = asking.recv_multipart()
    assert code == bytes([ControlResponse.FAILURE])
    assert ("another component is connected as Ours" if name else "a client without a name") in reason.decode()


def test_polling_peer_sees_short_states(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    theirs = subscriber(rig, plain, b"ScopeStateMsg")
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.FREE)))
    rig.until(lambda: theirs.state == FREE and ours.packets("ScopeStateMsg"))
    for _ in range(5):
        for passing in (ScopeState.MOVING, ScopeState.INTERRUPTED):
            seen: list[int | None] = []
            for state in (ScopeState.SCANNING, passing, ScopeState.FREE):
                rig.publish_packet(*wire.encode(ScopeStatus(state)))

            def all_told(seen: list[int | None] = seen) -> bool:
                seen.append(theirs.state)
                return seen[-1] == FREE and set(seen) != {FREE}

            rig.until(all_told)
            assert int(passing) in seen


def test_states_are_not_held_back_without_polling_peers(rig: Any, plain: Any) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.linked(ours)
    theirs = subscriber(rig, plain, b"ScopeStateMsg")
    rig.publish_packet(*wire.encode(ScopeStatus(ScopeState.FREE)))
    rig.until(lambda: theirs.state == FREE)
    rig.peers.remove(theirs)
    theirs.close()
    took_s: list[float] = []

    def at_once() -> bool:
        count, began_s = len(ours.packets("ScopeStateMsg")), time.monotonic()
        for state in (ScopeState.MOVING, ScopeState.FREE):
            rig.publish_packet(*wire.encode(ScopeStatus(state)))
        rig.until(lambda: len(ours.packets("ScopeStateMsg")) == count + 2)
        took_s.append(time.monotonic() - began_s)
        return took_s[-1] < 0.08

    rig.until(at_once)  # the end of a connection is seen a moment later


# --- their translator beside our scheduler ---


@pytest.fixture
def server(rig: Any, plain: Any) -> Server:
    rig.translator.close()
    rig.translator = None
    made = Server(plain(zmq.REP), plain(zmq.PUB), rig.source[1], rig.source[0])
    rig.peers.append(made)
    return made


def test_their_translator_is_sent_what_version_1_has_until_after_the_end(rig: Any, plain: Any, server: Server) -> None:
    rig.start()
    ours = rig.component("Ours")
    rig.until(lambda: ours.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok)
    assert ours.ask(ControlRequest.REQUEST_CTRL, 0).ok
    server.asked.clear()
    assert ours.ask(ControlRequest.ACTION, "start-scan").ok
    assert ours.ask(ControlRequest.RELEASE_CTRL).ok
    ask = client(rig, plain, "Theirs")
    assert ask(REQUEST, 0) == SUCCESS
    assert ask(4, feedback_pb2.ZCtrlParameters()) == SUCCESS
    server.answer = lambda frames: [b"\10"]  # as their translator refuses a parameter: without an object
    assert ask(PARAM, control_pb2.ParameterMsg(parameter="x-unknown")) == 8
    assert [frames[0][0] for frames in server.asked] == [1, 4, PARAM]
    assert server.asked[1] == [b"\4", b""]
    server.publish(control_pb2.ScopeStateMsg(scope_state=control_pb2.SS_SCANNING), CLOCK.now_ns())
    rig.until(lambda: ours.packets("ScopeStateMsg"))
    assert ask(END) == SUCCESS
    rig.until(lambda: any(isinstance(incoming, Killed) for incoming in ours.found))
    rig.until(lambda: rig.process.poll() is not None)
    stop = control_pb2.ActionMsg(action="stop-scan").SerializeToString()
    assert [*server.asked][3:] == [[b"\1", stop]], "its scan does not go on with nobody there"


def test_spectra_that_come_variable_after_variable_are_put_in_order(rig: Any, server: Server) -> None:
    rig.translator_settings = {"spectra_by_variable": True}
    rig.start()
    ours = rig.component("Ours")
    rig.until(lambda: ours.ask(ControlRequest.ACTION_SUPPORT, "start-scan").ok)
    values = np.array([[0.0, 1e-9], [0.1, 2e-9], [0.2, 3e-9]])
    told = spectroscopy_pb2.Spec1d(type="IV")
    told.data.CopyFrom(
        spectroscopy_pb2.SpecData(
            num_variables=2, data_per_variable=3, names=["bias", "current"], units=["V", "A"], values=values.T.ravel()
        )
    )
    server.publish(told, CLOCK.now_ns())
    ((_, payload),) = rig.until(lambda: ours.packets("Spec1d"))
    np.testing.assert_array_equal(wire.decode("Spec1d", payload).values, values)


# --- our components and supervisor beside their scheduler ---


def launch(router: Router) -> Launch:
    return Launch("supervisor:here", sockets=Sockets(control=router.address))


def test_supervisor_sends_nothing_to_a_published_scheduler_and_logs_it_once(router: Router) -> None:
    reporter = Reporter(launch(router), CLOCK, "here")
    complaints: list[str] = []
    reporter.post = lambda news: complaints.append(news.text) if isinstance(news, ReportFailed) else None
    reporter.start()
    reporter.states((ProcessState("one", "component", ProcessCondition.ALIVE, CLOCK.now_ns()),), changed=True)
    reporter.line("one", 20, "a line")
    until(lambda: complaints, router.pump)
    reporter.close()
    assert [text for text in complaints if "version 1" in text] == complaints[:1] == complaints
    assert router.asked == []


def test_with_their_scheduler_the_experiment_goes_by_real_time(router: Router) -> None:
    found: list[Any] = []
    told: list[str] = []
    asking = threading.Thread(target=lambda: found.append(run_identity.ask_scheduler(launch(router), told.append)))
    asking.start()
    until(lambda: found, router.pump)
    asking.join()
    assert (found[0].clock.speed, found[0].run, found[0].simulated) == (1.0, "", False)
    assert abs(found[0].clock.now_s() - time.time()) < 1.0
    assert any("version 1" in text for text in told)


@pytest.fixture
def port(router: Router) -> Iterator[ZmqPort]:
    made = ZmqPort(Network(), "Ours", CLOCK, control=router.address)
    yield made
    made.close()


class Pumped:
    """A port whose waits let their scheduler see to what has come."""

    def __init__(self, port: ZmqPort, router: Router) -> None:
        self._port, self._router = port, router
        self.clock = port.clock
        self.send, self.publish, self.close = port.send, port.publish, port.close
        self.wakeup_fileno = port.wakeup_fileno

    def poll(self, timeout_s: float | None) -> list[Any]:
        self._router.pump()
        return self._port.poll(0.01)


def test_our_component_asks_their_scheduler_what_version_1_has(port: ZmqPort, router: Router) -> None:
    link = ExperimentLink(Pumped(port, router), "Ours", session="a")  # type: ignore[arg-type]
    requests = [
        (ControlRequest.REQUEST_CTRL, 0),
        (ControlRequest.ACTION, "start-scan"),
        (ControlRequest.SET_ZCTRL_PARAMS, None),
        (ControlRequest.RELEASE_CTRL, None),
        (ControlRequest.END_EXPERIMENT, None),
    ]
    for kind, thing in requests:
        assert link.request(kind, thing).ok
        link.relay(LogLines(()))
    assert not link.request(RELAY_REQUEST, RelayedMessage("Progress", b"")).ok
    assert [frames[0][0] for _, frames in router.asked] == [int(kind) for kind, _ in requests]
