"""Decisions about one child: busy is not dead, restarts back off and have a budget."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.exit_codes import ExitCode
from afspm.basics.own_fault import OwnFault
from afspm.supervisor.supervision.child import (
    ChildLog,
    ChildPhase,
    ChildPolicy,
    ChildWatch,
    GiveUpChild,
    KillChild,
    RestartBudget,
    RestartPolicy,
    StartChild,
)
from afspm.supervisor.supervision.liveness import Liveness, LivenessPolicy, ProcessHealth


@dataclass(frozen=True)
class Beat:
    closing: bool = False
    step_age_s: float | None = 0.0
    longest_step_s: float | None = None


QUICK = LivenessPolicy(beat_period_s=1.0, missed_beats=3, start_s=10.0, longest_step_s=30.0, closing_s=5.0)


def checked(life: Liveness, until_s: float, from_s: float = 0.0, *, works: bool | None = None) -> ProcessHealth:
    """Return the health at `until_s`, checked every half second until then."""
    now_s = from_s
    while now_s < until_s:
        life.check(now_s, works=works)
        now_s += 0.5
    return life.check(until_s, works=works)


def test_process_with_three_missed_beats_is_silent() -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(0.0)
    assert checked(life, 2.9) is ProcessHealth.ALIVE
    assert checked(life, 3.0, 2.9) is ProcessHealth.SILENT


def test_long_step_is_busy_within_its_declared_limit() -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(1.0, step_age_s=29.0)
    assert life.check(1.0) is ProcessHealth.ALIVE
    life.beat(2.0, step_age_s=299.0, longest_step_s=300.0)
    assert life.check(2.0) is ProcessHealth.ALIVE
    life.beat(3.0, step_age_s=301.0, longest_step_s=300.0)
    assert life.check(3.0) is ProcessHealth.FROZEN


@pytest.mark.parametrize(("age_s", "longest_s"), [(0.0, None), (5.0, 35.0)])
def test_process_that_works_without_heartbeats_is_busy_within_the_step_limit(
    age_s: float, longest_s: float | None
) -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(0.0, age_s, longest_s)
    assert checked(life, 2.9, works=True) is ProcessHealth.ALIVE
    assert checked(life, 30.0, 2.9, works=True) is ProcessHealth.BUSY
    assert life.next_check_s() == 31.0, "nobody is to look all the time"
    assert checked(life, 30.1, 30.0, works=True) is ProcessHealth.FROZEN


@pytest.mark.parametrize("works", [False, None])
def test_process_that_neither_beats_nor_works_is_silent_at_once(works: bool | None) -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(0.0)
    assert checked(life, 10.0, works=True) is ProcessHealth.BUSY
    assert life.check(10.1, works=works) is ProcessHealth.SILENT


def test_process_that_beats_again_after_being_busy_is_alive() -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(0.0)
    assert checked(life, 10.0, works=True) is ProcessHealth.BUSY
    life.beat(10.5, step_age_s=10.5)
    assert life.check(10.5) is ProcessHealth.ALIVE
    assert checked(life, 30.0 + QUICK.silence_s, 10.5, works=True) is ProcessHealth.FROZEN, "it is the same step"


def test_heartbeat_after_closing_cancels_it() -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    watch.begin(0.0)
    watch.beat(Beat(), 0.5)
    watch.beat(Beat(closing=True), 1.0)
    for second in range(2, 20):
        assert watch.beat(Beat(), float(second)) == []
    assert watch.tick(21.0) == []
    assert [type(effect) for effect in watch.tick(30.0)] == [ChildLog, KillChild]


def test_first_heartbeat_is_required_even_of_a_working_process() -> None:
    assert checked(Liveness(QUICK, 0.0), 10.0, works=True) is ProcessHealth.SLOW_START


def test_process_that_works_on_its_end_has_the_step_limit() -> None:
    life = Liveness(QUICK, 10.0)
    life.beat(10.0)
    life.closing(11.0)
    assert checked(life, 16.0, 11.0, works=True) is ProcessHealth.BUSY
    assert checked(life, 41.0, 16.0, works=True) is ProcessHealth.BUSY
    assert checked(life, 41.1, 41.0, works=True) is ProcessHealth.NOT_CLOSING


def test_step_does_not_age_while_the_computer_sleeps() -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(0.0)
    assert checked(life, 10.0, works=True) is ProcessHealth.BUSY
    assert life.check(3610.0, works=True) is ProcessHealth.BUSY
    assert checked(life, 3640.0, 3610.0, works=True) is ProcessHealth.FROZEN


def test_a_start_may_take_longer_than_a_beat() -> None:
    life = Liveness(QUICK, 0.0)
    assert checked(life, 9.9) is ProcessHealth.STARTING
    assert checked(life, 10.0, 9.9) is ProcessHealth.SLOW_START


def test_a_process_that_may_not_begin_yet_is_not_late() -> None:
    life = Liveness(QUICK, 0.0)
    life.waits(8.0)
    assert checked(life, 17.9) is ProcessHealth.STARTING
    assert checked(life, 18.0, 17.9) is ProcessHealth.SLOW_START
    life.beat(19.0)
    life.waits(20.0)
    assert checked(life, 22.0, 19.0) is ProcessHealth.SILENT, "it has begun"


def test_closing_process_must_exit_soon() -> None:
    life = Liveness(QUICK, 0.0)
    life.beat(1.0)
    life.closing(2.0)
    assert checked(life, 6.9, 2.0) is ProcessHealth.ALIVE
    assert checked(life, 7.0, 6.9) is ProcessHealth.NOT_CLOSING


def test_no_process_is_judged_for_time_the_computer_slept() -> None:
    """The computer was suspended for an hour."""
    life = Liveness(QUICK, 0.0)
    life.beat(1.0)
    assert life.check(1.5) is ProcessHealth.ALIVE
    assert life.check(3601.5) is ProcessHealth.ALIVE
    assert checked(life, 3606.0, 3601.5) is ProcessHealth.SILENT


def test_process_without_heartbeats_is_judged_by_its_exit_only() -> None:
    life = Liveness(QUICK, 0.0, beats=False)
    assert checked(life, 1000.0) is ProcessHealth.ALIVE
    assert life.next_check_s() == 1000.0 + QUICK.beat_period_s, "nobody is to look all the time"


def test_the_first_restart_is_at_once_and_later_ones_wait_longer_and_longer() -> None:
    restarts = RestartBudget(RestartPolicy(budget=20, first_delay_s=0.25, factor=2.0, longest_delay_s=2.0))
    delays = [restarts.failed(float(n), lived_s=0.1) for n in range(7)]
    assert delays == [0.0, 0.25, 0.5, 1.0, 2.0, 2.0, 2.0]


def test_healthy_life_ends_a_row_of_failures() -> None:
    restarts = RestartBudget(RestartPolicy(healthy_s=30.0))
    for n in range(4):
        restarts.failed(float(n), lived_s=0.1)
    assert restarts.failed(100.0, lived_s=31.0) == 0.0


def test_the_budget_is_spent_within_its_window() -> None:
    restarts = RestartBudget(RestartPolicy(budget=3, window_s=100.0))
    assert all(restarts.failed(float(n), 1.0) is not None for n in range(3))
    assert restarts.failed(50.0, 1.0) is None
    assert restarts.failed(100.0, 1.0) is not None


def test_frozen_child_is_killed_and_restarted() -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    assert watch.begin(0.0) == [StartChild()]
    assert watch.beat(Beat(), 1.0) == []
    effects = watch.beat(Beat(step_age_s=31.0), 2.0)
    assert [type(e) for e in effects] == [ChildLog, KillChild]
    assert watch.tick(2.5) == []
    effects = watch.exited(-9, 3.0)
    assert StartChild() in effects
    assert watch.phase is ChildPhase.RUNNING


def test_child_that_works_without_heartbeats_is_killed_only_once_idle() -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    watch.begin(0.0)
    watch.beat(Beat(), 1.0)
    for tenths in range(10, 200):
        assert watch.tick(tenths / 10.0, works=True) == []
    effects = watch.tick(20.0, works=False)
    assert [type(e) for e in effects] == [ChildLog, KillChild]


@pytest.mark.parametrize("code", [0, 78, 80])
def test_child_that_ended_on_purpose_is_not_restarted(code: int) -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    watch.begin(0.0)
    effects = watch.exited(code, 1.0)
    assert StartChild() not in effects
    assert watch.over
    assert watch.deadline_s() is None


@pytest.mark.parametrize("code", [1, -9, -11, 137, 3, 81])
def test_crashed_child_is_restarted(code: int) -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    watch.begin(0.0)
    assert StartChild() in watch.exited(code, 1.0)


def test_child_that_was_asked_to_stop_has_not_crashed() -> None:
    """A child stopped by another program is restarted, since it is still needed; at the end it is not."""
    watch = ChildWatch(ChildPolicy(QUICK))
    assert watch.died(1)
    assert not watch.died(81)


def test_child_that_crashes_repeatedly_is_given_up() -> None:
    watch = ChildWatch(ChildPolicy(QUICK, RestartPolicy(budget=3)))
    watch.begin(0.0)
    now_s, effects = 0.0, []
    for _ in range(50):
        effects = watch.exited(1, now_s) if watch.phase is ChildPhase.RUNNING else watch.tick(now_s)
        if watch.over:
            break
        now_s += 0.5
    assert watch.phase is ChildPhase.GIVEN_UP
    assert [type(e) for e in effects] == [ChildLog, GiveUpChild]
    assert isinstance(effects[0], ChildLog)
    assert effects[0].level == "ERROR"


def test_delayed_restart_is_not_early() -> None:
    watch = ChildWatch(ChildPolicy(QUICK, RestartPolicy(first_delay_s=4.0)))
    watch.begin(0.0)
    watch.exited(1, 1.0)
    watch.exited(1, 2.0)
    assert watch.deadline_s() == 6.0
    assert watch.tick(5.9) == []
    assert watch.tick(6.0) == [StartChild()]


def test_stopped_child_is_over_with_any_exit_code() -> None:
    watch = ChildWatch(ChildPolicy(QUICK))
    watch.begin(0.0)
    watch.stop(1.0)
    assert watch.exited(-9, 2.0) == []
    assert watch.over


def test_child_that_waits_for_its_restart_is_not_started_after_a_stop() -> None:
    watch = ChildWatch(ChildPolicy(QUICK, RestartPolicy(first_delay_s=4.0)))
    watch.begin(0.0)
    watch.exited(1, 1.0)
    watch.exited(1, 1.5)
    watch.stop(2.0)
    assert watch.tick(100.0) == []


def test_a_command_that_can_not_be_started_counts_as_a_crash() -> None:
    watch = ChildWatch(ChildPolicy(QUICK, RestartPolicy(budget=2)))
    watch.begin(0.0)
    for now_s in (1.0, 2.0, 3.0):
        watch.start_failed("no such file", now_s)
        watch.tick(now_s + 0.9)
    assert watch.phase is ChildPhase.GIVEN_UP


calls = st.sampled_from(["beat", "old", "frozen", "closing", "crash", "done", "tick", "stop", "unstartable"])


@given(st.lists(st.tuples(calls, st.floats(0.0, 20.0)), max_size=60))
def test_there_is_never_a_second_process_and_nothing_after_the_end(story: list[tuple[str, float]]) -> None:
    watch = ChildWatch(ChildPolicy(QUICK, RestartPolicy(budget=4)))
    running, stopped, now_s = 0, False, 0.0

    def count(effects: list[object]) -> None:
        nonlocal running
        for effect in effects:
            if isinstance(effect, StartChild):
                assert not stopped
                running += 1
            assert running <= 1

    count([*watch.begin(now_s)])
    for call, wait_s in story:
        now_s += wait_s
        if call == "stop":
            watch.stop(now_s)
            stopped = True
        elif call in ("crash", "done") and running:
            running -= 1
            count([*watch.exited(1 if call == "crash" else 0, now_s)])
        elif call == "unstartable" and running and not stopped:
            running -= 1
            count([*watch.start_failed("no", now_s)])
        elif call in ("beat", "old", "frozen", "closing"):
            age_s = {"beat": 0.0, "old": None, "frozen": 99.0, "closing": 0.0}[call]
            count([*watch.beat(Beat(call == "closing", age_s), now_s)])
        else:
            count([*watch.tick(now_s)])


def ordered(watch: ChildWatch, now_s: float = 100.0) -> list[str]:
    return [type(effect).__name__ for effect in watch.restart(now_s)]


def test_ordered_restart_kills_and_starts_at_once_however_often() -> None:
    watch = ChildWatch(ChildPolicy(restart=RestartPolicy(budget=0)))
    watch.begin(0.0)
    for life in range(20):
        now_s = 100.0 + life
        assert ordered(watch, now_s) == ["ChildLog", "KillChild"]
        assert watch.restart(now_s) == []  # it is on its way
        assert [type(effect).__name__ for effect in watch.exited(-9, now_s)] == ["StartChild"]
    assert [type(effect).__name__ for effect in watch.exited(-9, 200.0)] == [
        "ChildLog",
        "GiveUpChild",
    ]  # that was no order


def test_child_that_ended_waits_or_is_given_up_is_started_by_order() -> None:
    done, waiting, given_up = (ChildWatch(ChildPolicy(restart=RestartPolicy(budget=budget))) for budget in (1, 2, 0))
    for watch in (done, waiting, given_up):
        watch.begin(0.0)
    done.exited(0, 1.0)
    waiting.exited(1, 1.0)
    waiting.exited(1, 1.1)
    given_up.exited(1, 1.0)
    assert waiting.phase is ChildPhase.WAITING
    assert [ordered(watch) for watch in (done, waiting, given_up)] == [["ChildLog", "StartChild"]] * 3
    assert [watch.phase for watch in (done, waiting, given_up)] == [ChildPhase.RUNNING] * 3


def test_restart_order_does_not_undo_the_end() -> None:
    watch = ChildWatch(ChildPolicy())
    watch.begin(0.0)
    watch.restart(1.0)
    watch.exited(80, 1.1)  # the experiment ended just then
    assert watch.phase is ChildPhase.DONE
    watch = ChildWatch(ChildPolicy())
    watch.begin(0.0)
    watch.stop(1.0)
    assert watch.restart(1.1) == []
    assert watch.exited(-9, 1.2) == []
    assert watch.phase is ChildPhase.DONE


FAULT = OwnFault("ValueError", "survey.py:12", kept=1)
CODE = int(ExitCode.OWN_FAULT)


def fails(*faults: OwnFault | None) -> ChildWatch:
    """Return a child that has exited with these faults in a row."""
    watch = ChildWatch(ChildPolicy())
    watch.begin(0.0)
    for number, fault in enumerate(faults, 1):
        watch.exited(CODE, 100.0 * number, fault=fault)
        watch.tick(100.0 * number + 50.0)
    return watch


def test_same_fault_twice_without_progress_is_given_up() -> None:
    assert fails(FAULT).phase is ChildPhase.RUNNING
    assert fails(FAULT, FAULT).phase is ChildPhase.GIVEN_UP


@pytest.mark.parametrize(
    "second",
    [
        OwnFault("ValueError", "survey.py:12", kept=2),
        OwnFault("ValueError", "survey.py:13", kept=1),
        OwnFault("KeyError", "survey.py:12", kept=1),
        None,
    ],
    ids=["progress", "another place", "another error", "a passing error"],
)
def test_other_exit_in_between_resets_the_fault_count(second: OwnFault | None) -> None:
    assert fails(FAULT, second, FAULT).phase is ChildPhase.RUNNING


def test_child_restarted_by_a_person_may_fail_once_more() -> None:
    watch = fails(FAULT, FAULT)
    assert StartChild() in watch.restart(300.0)
    watch.exited(CODE, 400.0, fault=FAULT)
    assert watch.phase is ChildPhase.RUNNING
    given_up = GiveUpChild(f"failed twice in the same way without progress ({FAULT})")
    assert given_up in watch.exited(CODE, 500.0, fault=FAULT)
