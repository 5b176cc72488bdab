"""How it is with a process, in one word and since when."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from afspm.experiment import Role
from afspm.launch import Launch
from afspm.logic.supervision.child import ChildPolicy, ChildWatch
from afspm.logic.supervision.liveness import LivenessPolicy
from afspm.model import ProcessCondition
from afspm.supervisor.process_status import ProcessStatus
from afspm.supervisor.task import Task
from afspm.transport.heartbeat import Heartbeat

Condition = ProcessCondition
POLICY = ChildPolicy(LivenessPolicy(beat_period_s=1.0))


@dataclass
class Clock:
    ns: int = 0

    def now_ns(self) -> int:
        return self.ns


@dataclass
class Process:
    pid: int


@dataclass
class Child:
    """As the supervisor has it."""

    task: Task = field(default_factory=lambda: Task(Launch("one"), (), Role.TRANSLATOR))
    watch: ChildWatch = field(default_factory=lambda: ChildWatch(POLICY))
    process: Process | None = None
    up: bool = False
    beat: Heartbeat | None = None
    beat_s: float = 0.0
    works: bool | None = None
    starts: int = 0
    given_up: bool = False
    last_exit: str = ""

    def start(self, pid: int) -> None:
        self.watch.begin(0.0)
        self.process, self.starts, self.up = Process(pid), self.starts + 1, False

    def beats(self, now_s: float, step_age_s: float = 0.0, *, closing: bool = False) -> None:
        self.up, self.beat, self.beat_s = True, Heartbeat("one", closing, step_age_s, 30.0), now_s
        self.watch.beat(self.beat, now_s)

    def ends(self, code: int, now_s: float) -> None:
        self.process = None
        self.watch.exited(code, now_s)


@pytest.fixture
def standing() -> ProcessStatus:
    return ProcessStatus(Clock(), POLICY.liveness)  # type: ignore[arg-type]


def test_through_its_life(standing: ProcessStatus) -> None:
    child = Child()
    assert standing.condition(child, 0.0) is Condition.STARTING
    child.start(7)
    assert standing.condition(child, 1.0) is Condition.STARTING
    child.beats(2.0)
    assert standing.condition(child, 2.5) is Condition.ALIVE
    child.beats(3.0, step_age_s=0.5)
    assert standing.condition(child, 3.5) is Condition.BUSY
    assert standing.condition(child, 5.5) is Condition.SILENT
    child.works = True
    assert standing.condition(child, 5.5) is Condition.BUSY
    child.beats(6.0)
    child.ends(1, 6.1)
    child.start(8)
    assert standing.condition(child, 6.2) is Condition.STARTING
    child.ends(1, 6.3)
    assert standing.condition(child, 6.4) is Condition.RESTARTING
    child.given_up = True
    assert standing.condition(child, 6.5) is Condition.GIVEN_UP


def test_one_that_is_done_has_ended_and_one_that_closes_is_not_silent(standing: ProcessStatus) -> None:
    child = Child()
    child.start(7)
    child.beats(1.0, closing=True)
    assert standing.condition(child, 5.0) is Condition.ALIVE
    child.ends(0, 5.0)
    assert standing.condition(child, 5.0) is Condition.ENDED


def test_one_that_is_killed_to_be_started_again_is_being_restarted(standing: ProcessStatus) -> None:
    child = Child()
    child.start(7)
    child.beats(1.0)
    child.watch.restart(1.5)
    assert standing.condition(child, 1.5) is Condition.RESTARTING


def test_one_that_sends_no_beats_is_taken_to_be_alive(standing: ProcessStatus) -> None:
    child = Child(Task(Launch("one"), (), beats=False))
    child.start(7)
    assert standing.condition(child, 1e6) is Condition.ALIVE


def test_a_change_is_told_once_and_since_when_it_is_so() -> None:
    clock = Clock(10)
    standing, child = ProcessStatus(clock, POLICY.liveness), Child()  # type: ignore[arg-type]
    child.start(7)
    (state,), changed = standing.of([child], 0.0)
    assert (state.role, state.pid, state.starts, state.since_ns, changed) == ("translator", 7, 1, 10, True)
    clock.ns = 20
    assert standing.of([child], 0.1) == ((state,), False)
    child.beats(1.0, step_age_s=0.25)
    (busy,), changed = standing.of([child], 1.5)
    assert (busy.since_ns, busy.step_age_s, changed) == (20, 0.75, True)
    clock.ns = 30
    child.beats(2.0, step_age_s=1.25)
    (busy,), changed = standing.of([child], 2.0)
    assert (busy.since_ns, busy.step_age_s, changed) == (20, 1.25, False)
