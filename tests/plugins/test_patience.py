"""The wait for a program that controls a microscope, in real time at any speed of the experiment's clock."""

from __future__ import annotations

import pytest

from afspm.basics import ExperimentClock
from afspm.plugins.gxsm import Gxsm


@pytest.mark.parametrize(("speed", "expected_s"), [(1.0, 5.0), (60.0, 120.0)])
def test_a_program_has_two_real_seconds_to_save_a_file_at_any_speed(speed: float, expected_s: float) -> None:
    microscope = Gxsm()
    microscope.clock = ExperimentClock.starting_now(speed=speed)
    assert microscope.patience_s(5.0) == pytest.approx(expected_s)
