"""Random calls neither end the emulated GXSM, nor spoil it, nor write outside its folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks.fuzz import fuzz
from benchmarks.fuzz.gxsm import GxsmFuzzer
from fake_clock import FakeClock
from rotation import ALL

from afspm.emulation import ControllerClock, Faults, SimulatedInstrument
from afspm.plugins.gxsm.emulator import GxsmEmulator
from afspm.plugins.gxsm.emulator.program import GxsmProgram, GxsmSettings

CALLS = 1000 if ALL else 300
KINDS: list[dict[str, Any]] = [{"version": 3}, {"version": 4, "transport": "shm"}]


@pytest.mark.parametrize("kind", KINDS, ids=["gxsm3-bridge", "gxsm4-shm"])
def test_random_calls_are_survived(tmp_path: Path, kind: dict[str, Any]) -> None:
    if "transport" in kind and not sys.platform.startswith("linux"):
        pytest.skip("Gxsm4's shared memory is there on Linux alone")
    outcome = fuzz(GxsmFuzzer, GxsmEmulator(**kind), tmp_path / "run", CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20


@pytest.fixture
def program(tmp_path: Path) -> GxsmProgram:
    clock = FakeClock()
    rig = SimulatedInstrument({}, 1, clock.t_s)
    settings = GxsmSettings(
        version=4,
        card="RPSPMC",
        user_unit="Å",
        decimal_comma=False,
        auto_save=True,
        probe_auto_save=True,
        reach_m=5e-6,
        display_units={},
        channels_set=True,
    )
    found = GxsmProgram(
        rig, Faults([], GxsmEmulator.all_faults(), clock.t_s), clock, ControllerClock(), tmp_path, settings
    )
    found.entries.set("PointsX", "8")
    return found


@pytest.mark.parametrize("ref", ["OffsetX", "Rotation"])
def test_scan_that_is_moved_keeps_its_size(program: GxsmProgram, ref: str) -> None:
    # faults 18: random calls of GXSM 3, seed 1, call 2,393, and of GXSM 4, call 3,443
    program.start_scan()
    program.entries.set("RangeX", "1")
    program.entries.set("RangeY", "20000")
    program.entries.set(ref, "20")
    assert program.scan.activity is not None
    [(_, moved)] = program.scan.elsewhere
    assert moved.region.size_m == program.scan.activity.region.size_m
    assert moved.region != program.scan.activity.region


@pytest.mark.parametrize("text", ["0", "abc", "1e-9", "1e-320"])
def test_range_below_a_step_of_the_converter_is_one_step(program: GxsmProgram, text: str) -> None:
    # faults 18: with 1e-320 all later moves and scans failed
    program.entries.set("RangeX", text)
    assert program.entries["RangeX"] == program.entries["RangeY"] == 0.422
    program.entries.set("OffsetX", "20")
    program.start_scan()
    assert program.scan.runs
