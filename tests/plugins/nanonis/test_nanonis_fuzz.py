"""Malicious requests; `make soak` makes more of them."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import pytest
from benchmarks.fuzz import fuzz
from benchmarks.fuzz.nanonis import NanonisFuzzer
from fake_clock import FakeClock

from afspm.emulation import ControllerClock, Faults, SimulatedInstrument
from afspm.plugins.nanonis.emulator import NanonisEmulator
from afspm.plugins.nanonis.emulator.dispatch import FunctionRefused
from afspm.plugins.nanonis.emulator.software import NanonisSoftware


def test_random_requests_neither_end_the_emulator_nor_write_elsewhere(tmp_path: Path) -> None:
    outcome = fuzz(NanonisFuzzer, NanonisEmulator(port=0), tmp_path, 2000, seed=7)
    assert outcome.answered > 500
    assert outcome.refused > 500


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def software(tmp_path: Path, clock: FakeClock) -> NanonisSoftware:
    return NanonisSoftware(
        SimulatedInstrument({}, 1, clock.t_s),
        Faults([], NanonisEmulator.all_faults(), clock.t_s),
        clock,
        tmp_path,
        session_path="",
        range_m=100e-6,
        release=NanonisEmulator().release,
        rows_as_recorded=False,
        unscanned=math.nan,
        clips_frames=False,
        file_clock=ControllerClock(),
        log=logging.getLogger(),
    )


def test_series_of_scans_ends_at_a_frame_that_can_not_be_scanned(
    software: NanonisSoftware, clock: FakeClock, caplog: pytest.LogCaptureFixture
) -> None:
    # faults 18: random calls, seed 1, call 11,241: the next scan of the series ended with a traceback
    call, rig = software.functions.call, software.core.rig
    call("Scan.BufferSet", [[], 16, 16])
    call("Scan.PropsSet", [1, 0, 0, "", "", []])
    call("Scan.Action", [0, 1])
    call("Scan.FrameSet", [0.0, 0.0, 1e-11, 1e-4, 0.0])
    assert rig.scan is not None
    clock.t_s = rig.scan.end_s
    software.advance(clock.t_s)
    assert call("Scan.StatusGet", []) == (0,)
    assert "the scan does not begin: a frame of" in caplog.text


@pytest.mark.parametrize("size", [(16, 2**31 - 1), (2**24, 2), (2**24, 0)])
def test_more_pixels_than_a_scan_may_have_are_refused(software: NanonisSoftware, size: tuple[int, int]) -> None:
    # faults 18: a later FrameDataGrab needed 512 GiB
    call = software.functions.call
    before = call("Scan.BufferGet", [])
    with pytest.raises(FunctionRefused, match="are more than 16777216 pixels"):
        call("Scan.BufferSet", [[0], *size])
    assert call("Scan.BufferGet", []) == before
