from __future__ import annotations

from afspm.supervisor.ending import KILL_AFTER_S, OWN_PACE_S, Ending, Why


def test_ctrl_c_asks_at_once_and_kills_within_two_seconds() -> None:
    ending = Ending.begin(Why.STOPPED, "Ctrl-C", 100.0)
    assert ending.ask_s == 100.0
    assert ending.kill_s <= 101.5


def test_at_the_end_of_the_experiment_all_may_finish_first() -> None:
    ending = Ending.begin(Why.EXPERIMENT_ENDED, "", 100.0)
    assert ending.deadline_s() == 100.0 + OWN_PACE_S
    assert ending.kill_s == 100.0 + OWN_PACE_S + KILL_AFTER_S


def test_a_second_ctrl_c_kills_at_once() -> None:
    assert Ending.begin(Why.EXPERIMENT_ENDED, "", 100.0).hurried(100.2).kill_s == 100.2


def test_an_end_on_purpose_is_a_success_and_a_loss_is_none() -> None:
    assert Why.EXPERIMENT_ENDED.exit_code == Why.ALL_DONE.exit_code == 0
    assert Why.LOST.exit_code == 1
    assert Why.STOPPED.exit_code not in (0, 1)
