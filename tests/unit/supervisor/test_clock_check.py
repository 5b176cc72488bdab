"""That the clock on the wall has left the run's is said, once."""

from __future__ import annotations

import time

import pytest

from afspm.clock import ExperimentClock
from afspm.supervisor.clock_check import PARTED_S, ClockCheck


@pytest.mark.parametrize(
    ("step_s", "said"),
    [(3600.0, "1 h 00 min ahead of"), (-7200.0, "2 h 00 min behind"), (PARTED_S / 2, None), (-PARTED_S / 2, None)],
)
def test_when_the_clock_on_the_wall_is_set_that_is_said_once(
    monkeypatch: pytest.MonkeyPatch, step_s: float, said: str | None
) -> None:
    wall_s = time.time
    told: list[str] = []
    wall = ClockCheck(ExperimentClock.starting_now(), told.append)
    wall.look()
    assert told == []
    monkeypatch.setattr(time, "time", lambda: wall_s() + step_s)
    wall.look()
    wall.look()
    assert len(told) == (said is not None)
    assert said is None or said in told[0]


def test_of_a_time_that_passes_faster_nothing_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_s = time.time
    told: list[str] = []
    wall = ClockCheck(ExperimentClock.starting_now(speed=60.0), told.append)
    monkeypatch.setattr(time, "time", lambda: wall_s() + 3600.0)
    wall.look()
    assert told == []
