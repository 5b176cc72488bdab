from __future__ import annotations

import pytest

from afspm.supervisor.supervision.run_end import (
    FAREWELL_S,
    KILL_AFTER_S,
    LEAVE_AFTER_S,
    OWN_PACE_S,
    TIP_S,
    EndReason,
    EndStep,
    RunEnd,
)


def test_ctrl_c_asks_at_once_and_kills_within_two_seconds() -> None:
    ending = RunEnd.begin(EndReason.STOPPED, "Ctrl-C", 100.0)
    assert ending.ask_s == 100.0
    assert ending.kill_s <= 101.5


def test_processes_may_finish_after_an_announced_end() -> None:
    ending = RunEnd.begin(EndReason.EXPERIMENT_ENDED, "", 100.0)
    assert ending.deadline_s() == 100.0 + OWN_PACE_S
    assert ending.kill_s == 100.0 + OWN_PACE_S + KILL_AFTER_S


def test_a_second_ctrl_c_kills_at_once() -> None:
    ending, _ = RunEnd.begin(EndReason.STOPPED, "", 100.0).step(100.0)
    assert ending.hurried(100.2).step(100.2)[1] is EndStep.KILL


def test_second_ctrl_c_before_the_first_step_kills_at_once() -> None:
    assert RunEnd.begin(EndReason.STOPPED, "", 100.0).hurried(100.0).step(100.0)[1] is EndStep.KILL


def test_ctrl_c_at_the_end_of_the_experiment_asks_first() -> None:
    ending = RunEnd.begin(EndReason.EXPERIMENT_ENDED, "", 100.0).hurried(100.2)
    assert ending.step(100.2, busy=True)[1] is EndStep.ASK


def test_ctrl_c_after_a_kill_changes_nothing() -> None:
    ending, _ = RunEnd.begin(EndReason.STOPPED, "", 100.0).step(100.0)
    ending, _ = ending.hurried(100.2).step(100.2)
    assert ending.hurried(100.3) == ending


def test_busy_process_is_waited_for_at_the_end_within_a_limit() -> None:
    ending = RunEnd.begin(EndReason.EXPERIMENT_ENDED, "", 100.0)
    now_s, do = 100.0, None
    while do is None:
        assert now_s <= 100.0 + FAREWELL_S
        deadline_s = ending.deadline_s()
        assert deadline_s is not None
        now_s = deadline_s
        ending, do = ending.step(now_s, busy=True)
    assert do is EndStep.ASK
    assert now_s == 100.0 + FAREWELL_S


def test_busy_process_is_not_waited_for_after_ctrl_c() -> None:
    assert RunEnd.begin(EndReason.STOPPED, "", 100.0).step(100.0, busy=True)[1] is EndStep.ASK


def test_process_that_retracts_the_tip_is_not_killed_within_a_limit() -> None:
    ending, _ = RunEnd.begin(EndReason.STOPPED, "", 100.0).step(100.0)
    kept, do = ending.step(100.0 + KILL_AFTER_S, busy=True)
    assert do is None
    assert kept.hurried(102.0).step(102.0, busy=True)[1] is EndStep.KILL
    now_s = 100.0
    while do is None:
        deadline_s = ending.deadline_s()
        assert deadline_s is not None
        now_s = deadline_s
        ending, do = ending.step(now_s, busy=True)
    assert (do, now_s) == (EndStep.KILL, 100.0 + TIP_S)


def test_process_that_has_retracted_the_tip_has_the_usual_time_to_end() -> None:
    for busy_until_s in (101.4, 105.0):  # before others are killed, and after
        ending, do = RunEnd.begin(EndReason.STOPPED, "", 100.0).step(100.0)
        for tenth in range(1001, 1200):
            now_s = tenth / 10
            ending, do = ending.step(now_s, busy=now_s <= busy_until_s)
            if do:
                break
        assert (do, now_s) == (EndStep.KILL, pytest.approx(busy_until_s + KILL_AFTER_S))


def test_each_stage_comes_once_and_in_its_time() -> None:
    ending = RunEnd.begin(EndReason.STOPPED, "Ctrl-C", 100.0)
    done = []
    for tenth in range(100):
        ending, do = ending.step(100.0 + tenth / 10)
        if do:
            done.append((do, tenth / 10))
    assert done == [(EndStep.ASK, 0.0), (EndStep.KILL, KILL_AFTER_S), (EndStep.LEAVE, KILL_AFTER_S + LEAVE_AFTER_S)]
    assert ending.deadline_s() is None


def test_an_end_on_purpose_is_a_success_and_a_loss_is_none() -> None:
    assert EndReason.EXPERIMENT_ENDED.exit_code == EndReason.ALL_DONE.exit_code == 0
    assert EndReason.LOST.exit_code == 1
    assert EndReason.STOPPED.exit_code not in (0, 1)
