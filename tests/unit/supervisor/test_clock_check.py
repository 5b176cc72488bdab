"""One warning when the wall clock departs from the run's clock."""

from __future__ import annotations

import time

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.supervisor.supervisor import TOLERANCE_S, ClockCheck


@pytest.mark.parametrize(
    ("step_s", "said"),
    [
        (3600.0, "1 h 00 min ahead of"),
        (-7200.0, "2 h 00 min behind"),
        (TOLERANCE_S / 2, None),
        (-TOLERANCE_S / 2, None),
    ],
)
def test_change_of_the_wall_clock_is_warned_of_once(
    monkeypatch: pytest.MonkeyPatch, step_s: float, said: str | None
) -> None:
    wall_s = time.time
    check = ClockCheck(ExperimentClock.starting_now())
    assert check.warning() == ""
    monkeypatch.setattr(time, "time", lambda: wall_s() + step_s)
    told = check.warning()
    assert bool(told) == (said is not None)
    assert said is None or said in told
    assert check.warning() == ""


def test_faster_simulated_time_is_not_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_s = time.time
    check = ClockCheck(ExperimentClock.starting_now(speed=60.0))
    monkeypatch.setattr(time, "time", lambda: wall_s() + 3600.0)
    assert check.warning() == ""
