"""A supervisor reports its processes to a real scheduler, and carries out its orders."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from systems import KILLED_FROM_OUTSIDE, kill
from tests.system.supervisor.supervisor_lab import BEAT_S, Running, RunTasks, peer

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.experiment import Role
from afspm.model import (
    RESTART_REQUEST,
    ControlRequest,
    ControlResponse,
    JournalEntry,
    LogLine,
    ProcessCondition,
    ProcessState,
    Request,
    Response,
)
from afspm.supervisor.ports import FreePorts
from afspm.supervisor.process import HOST, Task
from afspm.supervisor.reporter import Reporter
from afspm.supervisor.supervision.supervisor_events import describe_exit
from afspm.transport import keys
from afspm.transport.network import Network
from afspm.transport.port import ControlConnected, PacketReceived, ReplyReceived, RequestReceived
from afspm.transport.zmq_port import ZmqPort
from afspm.transport.zmq_server import ZmqServerPort

CLOCK = ExperimentClock.real()
Condition = ProcessCondition


class Listener:
    """Subscribes to process states, log lines and entries, and sends requests as "dashboard:Ada"."""

    def __init__(self, network: Network, publish: str, serve: str) -> None:
        envelopes = ["ProcessStates", "LogLines", "JournalEntries"]
        self.port = ZmqPort(network, "dashboard:Ada", CLOCK, subscribe=[publish], envelopes=envelopes, control=serve)
        self.processes: dict[str, list[ProcessState]] = {}
        self.lines: list[LogLine] = []
        self.entries: list[JournalEntry] = []
        self.connected = False
        self._answers: dict[str, Response] = {}

    def until(self, condition: Callable[[], Any]) -> Any:
        """Listen until the condition is true, and return its value."""
        deadline_s = CLOCK.monotonic_s() + DEADLINE_S
        while not (value := condition()):
            assert CLOCK.monotonic_s() < deadline_s, f"it did not happen: {self.lines} {self.entries}"
            for incoming in self.port.poll(0.2):
                if isinstance(incoming, PacketReceived):
                    self._take(incoming.packet.envelope, incoming.packet.payload)
                elif isinstance(incoming, ReplyReceived):
                    self._answers[incoming.response.id] = incoming.response
                elif isinstance(incoming, ControlConnected):
                    self.connected = True
        return value

    def _take(self, envelope: str, payload: Any) -> None:
        message = wire.message_of(envelope)
        thing = wire.decode(message, payload)
        if message == "ProcessStates":
            for state in thing.processes:
                self.processes.setdefault(state.name, []).append(state)
        elif message == "LogLines":
            self.lines += thing.lines
        else:
            self.entries += thing.entries

    def ask(self, kind: int, subject: Any = None) -> Response:
        self.until(lambda: self.connected)
        asked = f"dashboard:Ada/session/{len(self._answers)}"
        self.port.send(wire.encode_request(Request(kind, subject, id=asked)))
        answer: Response = self.until(lambda: self._answers.get(asked))
        return answer

    def alive(self, name: str, starts: int) -> ProcessState:
        """Wait until the n-th start of a process is alive."""

        def found() -> ProcessState | None:
            up = [s for s in self.processes.get(name, []) if s.condition in (Condition.ALIVE, Condition.BUSY)]
            return next((state for state in up if state.starts == starts), None)

        state: ProcessState = self.until(found)
        return state


class Rig:
    """A scheduler and two components under a supervisor, and a listener."""

    def __init__(self, folder: Path, run_tasks: RunTasks, *, locked: bool) -> None:
        ports = FreePorts()
        self.publish, self.serve = ports.address(), ports.address()
        self._keys: Path | None = None
        if locked:
            self._keys = folder / "keys"
            keys.generate(self._keys, ["scheduler", "translator", "supervisor", "dashboard"])
        owners = {ports.address(): "translator", ports.address(): "translator"}
        sockets = Sockets(self.publish, (next(iter(owners)),), self.serve, list(owners)[1])
        launch = Launch(
            "scheduler",
            "afspm.scheduler.Scheduler",
            {"control": {"roles": {"restart": ["dashboard"], "end_experiment": ["boss"]}}},
            sockets,
            state_dir=str(folder / "state"),
            beat_period_s=BEAT_S,
            keys=self._folder(owners),
        )
        scheduler = Task(launch, (sys.executable, "-m", HOST), Role.SCHEDULER)
        asking = Launch(
            "supervisor:lab", sockets=Sockets(control=self.serve), keys=self._folder({self.serve: "scheduler"})
        )
        self.running: Running = run_tasks(scheduler, peer("one"), peer("two"), reporter=Reporter(asking, CLOCK, "lab"))
        servers = dict.fromkeys((self.publish, self.serve), "scheduler")
        network = Network(None if self._keys is None else keys.load(self._keys, "dashboard", servers))
        self.listener = Listener(network, self.publish, self.serve)

    def _folder(self, owners: dict[str, str]) -> dict[str, str] | None:
        return None if self._keys is None else {"folder": str(self._keys), **owners}


@pytest.fixture(params=[False, True], ids=["open", "with keys"])
def rig(request: pytest.FixtureRequest, tmp_path: Path, run_tasks: RunTasks) -> Iterator[Rig]:
    made = Rig(tmp_path, run_tasks, locked=request.param)
    yield made
    made.listener.port.close()


def test_processes_lines_and_refusals_are_published_and_orders_are_carried_out(rig: Rig) -> None:
    listener = rig.listener
    first = listener.alive("one", 1)
    assert (first.role, first.pid) == ("component", rig.running.pid("one"))
    assert listener.alive("scheduler", 1).role == "scheduler"

    kill(first.pid)
    second = listener.alive("one", 2)
    assert second.pid != first.pid
    assert second.since_ns >= first.since_ns
    assert second.last_exit == describe_exit(KILLED_FROM_OUTSIDE)
    listener.until(lambda: any(line.name == "one" and "restarting" in line.text for line in listener.lines))

    listener.until(lambda: listener.ask(RESTART_REQUEST, "two").ok)
    listener.alive("two", 2)
    listener.until(lambda: [entry.what for entry in listener.entries if entry.kind == "order"] == ["restart two"])
    assert listener.ask(RESTART_REQUEST, "three").code == ControlResponse.FAILURE
    assert listener.ask(ControlRequest.END_EXPERIMENT).code == ControlResponse.FAILURE
    refused = listener.until(lambda: [e for e in listener.entries if e.refused and e.kind == "request"])
    assert (refused[0].who, refused[0].what) == ("dashboard:Ada", "ends the experiment")
    assert refused[0].reason == "dashboard:Ada does not have the role end_experiment ([control.roles])"

    _, one, two = rig.running.stop().reports
    assert (one.starts, one.ordered) == (2, 0)
    assert (two.starts, two.ordered) == (2, 1)


def test_restarted_scheduler_gets_all_states_again_and_keeps_its_own(tmp_path: Path, run_tasks: RunTasks) -> None:
    rig = Rig(tmp_path, run_tasks, locked=False)
    listener = rig.listener
    try:
        listener.alive("one", 1)
        listener.until(lambda: listener.ask(ControlRequest.REQUEST_CTRL, 0).ok)
        listener.until(lambda: any(entry.what == "in control" for entry in listener.entries))
        kill(rig.running.pid("scheduler"))
        listener.alive("scheduler", 2)
        listener.until(lambda: any(entry.what.startswith("started again; dashboard") for entry in listener.entries))
        late = Listener(Network(), rig.publish, rig.serve)
        try:
            late.until(lambda: any(entry.what.startswith("started again") for entry in late.entries))
            assert late.entries == listener.entries  # each once, in the same order
        finally:
            late.port.close()
    finally:
        listener.port.close()


def test_supervisor_works_and_ends_without_a_scheduler(run_tasks: RunTasks) -> None:
    nowhere = Launch("supervisor:lab", sockets=Sockets(control=FreePorts().address()))
    crashing = peer("one", first="crash")
    running = run_tasks(crashing, peer("two"), reporter=Reporter(nowhere, CLOCK, "lab"))
    running.terminal.wait_for("CRITICAL", "gave up one")
    _, two = running.stop().reports
    assert two.last_exit == "ended as it was asked to"


def test_components_begin_once_their_own_scheduler_has_answered(run_tasks: RunTasks) -> None:
    address = FreePorts().address()
    asking = Launch("supervisor:lab", sockets=Sockets(control=address))
    tasks = (peer("scheduler", Role.SCHEDULER), peer("one"), peer("microscope", Role.TRANSLATOR))
    running = run_tasks(*tasks, reporter=Reporter(asking, CLOCK, "lab"))
    running.terminal.wait_for(" microscope ", "life 1")
    kill(running.pid("microscope"))
    running.terminal.wait_for(" microscope ", "life 1", count=2)  # all others, started at the same time, are ready
    assert not any(" one " in line and "life 1" in line for line in running.terminal.lines)
    port = ZmqServerPort(Network(), CLOCK, serve=address, publish=None)
    try:
        asked = None
        while not isinstance(asked, RequestReceived):
            asked = next(iter(port.poll(DEADLINE_S)), None)
        port.reply(wire.encode_response(Response(0, id=wire.decode_request(asked.frames).id)))
        running.terminal.wait_for(" one ", "life 1")
    finally:
        port.close()


def test_missing_key_is_logged_and_disturbs_nothing_else(tmp_path: Path, run_tasks: RunTasks) -> None:
    keys.generate(tmp_path / "keys", ["scheduler"])
    address = FreePorts().address()
    entries = {"folder": str(tmp_path / "keys"), address: "scheduler"}
    launch = Launch("supervisor:lab", sockets=Sockets(control=address), keys=entries)
    running = run_tasks(peer("one"), reporter=Reporter(launch, CLOCK, "lab"))
    running.terminal.wait_for("WARNING", "the scheduler refused the report", "key can't be read")
    running.terminal.wait_for(" one ", "life 1")
