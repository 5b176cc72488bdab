"""Condition of a process, and since when it holds."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from afspm.basics.exit_codes import ExitCode
from afspm.model import ProcessCondition, Role
from afspm.supervisor.supervision.child import ChildPolicy, ChildWatch
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervision.process_status import ProcessStatus, condition_of
from afspm.supervisor.supervision.supervised_child import ChildLife, ChildSpec, SupervisedChild

Condition = ProcessCondition
POLICY = ChildPolicy(LivenessPolicy(beat_period_s=1.0))


class Beat(NamedTuple):
    closing: bool = False
    step_age_s: float | None = None
    longest_step_s: float | None = None


class Child(SupervisedChild):
    """A child whose life the test sets."""

    def __init__(self, *, beats: bool = True) -> None:
        super().__init__(ChildSpec("one", Role.TRANSLATOR, beats), ChildWatch(POLICY))

    def start(self, pid: int) -> None:
        self.watch.begin(0.0)
        self.life, self.starts = ChildLife(pid, 0.0), self.starts + 1

    def beats(self, now_s: float, step_age_s: float = 0.0, *, closing: bool = False) -> None:
        assert self.life
        self.life.beat, self.life.beat_s = Beat(closing, step_age_s, 30.0), now_s
        self.watch.beat(self.life.beat, now_s)

    def ends(self, code: int, now_s: float) -> None:
        self.life = None
        self.watch.exited(code, now_s)

    def condition(self, now_s: float) -> Condition:
        return condition_of(self, now_s, POLICY.liveness)


def test_condition_follows_the_life_of_a_process() -> None:
    child = Child()
    assert child.condition(0.0) is Condition.STARTING
    child.start(7)
    assert child.condition(1.0) is Condition.STARTING
    child.beats(2.0)
    assert child.condition(2.5) is Condition.ALIVE
    child.beats(3.0, step_age_s=0.5)
    assert child.condition(3.5) is Condition.BUSY
    assert child.condition(5.5) is Condition.SILENT
    assert child.life
    child.life.works = True
    assert child.condition(5.5) is Condition.BUSY
    child.beats(6.0)
    child.ends(1, 6.1)
    child.start(8)
    assert child.condition(6.2) is Condition.STARTING
    child.ends(1, 6.3)
    assert child.condition(6.4) is Condition.RESTARTING
    child.given_up = True
    assert child.condition(6.5) is Condition.GIVEN_UP


def test_finished_process_has_ended_and_a_closing_one_is_not_silent() -> None:
    child = Child()
    child.start(7)
    child.beats(1.0, closing=True)
    assert child.condition(5.0) is Condition.ALIVE
    child.ends(0, 5.0)
    assert child.condition(5.0) is Condition.ENDED


def test_process_killed_for_a_restart_is_restarting() -> None:
    child = Child()
    child.start(7)
    child.beats(1.0)
    child.watch.restart(1.5)
    assert child.condition(1.5) is Condition.RESTARTING


def test_process_without_heartbeats_counts_as_alive() -> None:
    child = Child(beats=False)
    child.start(7)
    assert child.condition(1e6) is Condition.ALIVE


def test_change_is_reported_once_with_its_time() -> None:
    status, child = ProcessStatus(POLICY.liveness), Child()
    child.start(7)
    (state,), changed = status.states([child], 0.0, 10)
    assert (state.role, state.pid, state.starts, state.since_ns, changed) == ("translator", 7, 1, 10, True)
    assert status.states([child], 0.1, 20) == ((state,), False)
    child.beats(1.0, step_age_s=0.25)
    (busy,), changed = status.states([child], 1.5, 20)
    assert (busy.since_ns, busy.step_age_s, changed) == (20, 0.75, True)
    child.beats(2.0, step_age_s=1.25)
    (busy,), changed = status.states([child], 2.0, 30)
    assert (busy.since_ns, busy.step_age_s, changed) == (20, 1.25, False)


def test_a_process_at_work_on_a_step_or_late_with_a_beat_is_alive_since_it_came_up() -> None:
    child, status = Child(), ProcessStatus(POLICY.liveness)

    def since_s(now_s: float) -> int:
        ((state,), _) = status.states([child], now_s, int(now_s))
        return state.since_ns

    child.start(7)
    assert since_s(1.0) == 1
    child.beats(2.0)
    assert since_s(2.0) == 2
    child.beats(10.0, step_age_s=0.5)
    assert since_s(10.0) == 2
    assert since_s(13.0) == 13, "silent"
    child.beats(14.0)
    assert since_s(14.0) == 2
    child.ends(1, 15.0)
    child.start(8)
    child.beats(16.0)
    assert since_s(16.0) == 16


# paper F6
def test_process_has_begun_after_the_end_of_its_first_step() -> None:
    child, status = Child(), ProcessStatus(POLICY.liveness)
    assert not status.all_begun([child], 0.0)
    child.start(7)
    assert not status.all_begun([child], 1.0)
    child.beats(2.0, step_age_s=0.5)
    assert not status.all_begun([child], 2.0), "it imports its libraries"
    assert not status.all_begun([child], 5.0), "and keeps Python's lock meanwhile"
    child.beats(6.0)
    assert status.all_begun([child], 6.0)
    child.beats(7.0, step_age_s=0.5)
    assert status.all_begun([child], 7.0)


def test_process_restarted_at_once_has_begun() -> None:
    child, status = Child(), ProcessStatus(POLICY.liveness)
    child.start(7)
    child.ends(1, 1.0)
    child.start(8)
    assert status.all_begun([child], 1.0)


@pytest.mark.parametrize("code", [ExitCode.DONE, ExitCode.CONFIG])
def test_process_that_ends_at_once_has_begun(code: ExitCode) -> None:
    child, status = Child(), ProcessStatus(POLICY.liveness)
    child.start(7)
    child.ends(code, 1.0)
    assert status.all_begun([child], 1.0)
