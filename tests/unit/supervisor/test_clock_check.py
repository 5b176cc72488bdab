"""A warning, once, when the clock on the wall leaves that of the run."""

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
def test_when_the_clock_on_the_wall_is_set_that_is_said_once(
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


def test_of_a_time_that_passes_faster_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_s = time.time
    check = ClockCheck(ExperimentClock.starting_now(speed=60.0))
    monkeypatch.setattr(time, "time", lambda: wall_s() + 3600.0)
    assert check.warning() == ""
