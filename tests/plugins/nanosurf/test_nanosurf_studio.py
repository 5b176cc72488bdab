"""The emulated Studio's program, without its protocol."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from fake_clock import FakeClock

from afspm.emulation import Faults, SimulatedInstrument
from afspm.plugins.nanosurf.emulator import NanosurfEmulator
from afspm.plugins.nanosurf.emulator.studio import StudioProgram


class RunningClock(FakeClock):
    """A clock on which half a line of a scan passes between two reads."""

    def now_s(self) -> float:
        self.t_s += 0.5
        return self.t_s


def studio(clock: FakeClock, folder: Path, **world: object) -> StudioProgram:
    rig = SimulatedInstrument(world, 1, clock.t_s)
    faults = Faults([], NanosurfEmulator.all_faults(), clock.t_s)
    return StudioProgram(rig, faults, clock, folder, logging.getLogger(), start_s=0.0, file_s=0.0)


def test_curves_with_an_impossible_setpoint_end_as_if_stopped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    # faults 18
    clock = FakeClock()
    program = studio(clock, tmp_path)
    program.put("z_control.setpoint", -1.0)
    program.start_curves(clock.t_s)
    for _ in range(5):
        program.advance(clock.t_s)
        clock.t_s += 1.0
    assert not program.measuring_curve
    assert "the curves were interrupted: feedback: a setpoint is above zero, not -1" in caplog.text


def test_setpoint_and_gain_of_the_panel_are_in_force_at_once(tmp_path: Path) -> None:
    program = studio(FakeClock(), tmp_path)
    program.put("z_control.setpoint", 0.5)
    program.put("z_control.i_gain", 2000)
    feedback = program.rig.setup.feedback
    assert (feedback.setpoint, feedback.integral_gain) == (0.5, 1000.0)


def test_next_curve_of_a_grid_waits_for_the_feedback(tmp_path: Path) -> None:
    clock = FakeClock()
    program = studio(clock, tmp_path, feedback={"hold_s": 5.0})
    program.put("spectroscopy.grid_columns", 2)
    program.start_curves(clock.t_s)
    starts = set()
    while program.measuring_curve:
        program.advance(clock.t_s)
        curve = program.rig.spectrum
        starts |= {curve.start_s} if curve is not None else set()
        clock.t_s += 0.1
    first_s, second_s = sorted(starts)
    assert second_s >= first_s + program.rig.world.settings.force.duration_s + 5.0


@pytest.mark.parametrize("direction", [0, 1])
def test_buffered_lines_are_complete_while_the_next_line_ends(direction: int, tmp_path: Path) -> None:
    clock = RunningClock()
    program = studio(clock, tmp_path)
    for path, value in (("lines_per_frame", 8), ("points_per_line", 4), ("slow_axis_scan_direction", direction)):
        program.put(f"imaging.{path}", value)
    program.start_scan(clock.t_s)
    program.advance(clock.t_s)
    counts = set()
    for _ in range(20):
        lines = program.lines()
        [count] = {len(values) for _, _, values in lines}
        assert all(np.isfinite(values).all() for _, _, values in lines)
        counts.add(count // 4)
    assert {1, 2, 3, 4, 5, 6, 7, 8} <= counts
