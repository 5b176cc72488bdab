"""One warning when the wall clock departs from the run's clock."""

from __future__ import annotations

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.supervisor.supervisor import TOLERANCE_S, ClockCheck


class SteppedWall(ExperimentClock):
    """A clock beside a wall clock that a test sets by `step_s`."""

    step_s = 0.0

    def wall_ahead_s(self) -> float:
        return super().wall_ahead_s() + self.step_s


@pytest.mark.parametrize(
    ("step_s", "said"),
    [
        (3600.0, "1 h 00 min ahead of"),
        (-7200.0, "2 h 00 min behind"),
        (TOLERANCE_S / 2, None),
        (-TOLERANCE_S / 2, None),
    ],
)
def test_change_of_the_wall_clock_is_warned_of_once(step_s: float, said: str | None) -> None:
    clock = SteppedWall.starting_now()
    check = ClockCheck(clock)
    assert check.warning() == ""
    clock.step_s = step_s
    told = check.warning()
    assert bool(told) == (said is not None)
    assert said is None or said in told
    assert check.warning() == ""


def test_faster_simulated_time_is_not_warned_of() -> None:
    clock = SteppedWall.starting_now(speed=60.0)
    check = ClockCheck(clock)
    clock.step_s = 3600.0
    assert check.warning() == ""
