"""Malicious requests; `make soak` makes more of them."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
from benchmarks.fuzz import fuzz
from benchmarks.fuzz.nanonis import NanonisFuzzer
from fake_clock import FakeClock

from afspm.emulation import Faults, SimulatedInstrument
from afspm.plugins.nanonis.emulator import NanonisEmulator
from afspm.plugins.nanonis.emulator.software import NanonisSoftware


def test_random_requests_neither_end_the_emulator_nor_write_elsewhere(tmp_path: Path) -> None:
    outcome = fuzz(NanonisFuzzer, NanonisEmulator(port=0), tmp_path, 2000, seed=7)
    assert outcome.answered > 500
    assert outcome.refused > 500


def test_series_of_scans_ends_at_a_frame_that_can_not_be_scanned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    # faults 18: random calls, seed 1, call 11,241: the next scan of the series ended with a traceback
    clock = FakeClock()
    rig = SimulatedInstrument({}, 1, clock.t_s)
    software = NanonisSoftware(
        rig,
        Faults([], NanonisEmulator.all_faults(), clock.t_s),
        clock,
        tmp_path,
        session_path="",
        range_m=100e-6,
        release=NanonisEmulator().release,
        rows_as_recorded=False,
        log=logging.getLogger(),
    )
    call = software.functions.call
    call("Scan.BufferSet", [[], 16, 16])
    call("Scan.PropsSet", [1, 0, 0, "", "", []])
    call("Scan.Action", [0, 1])
    call("Scan.FrameSet", [0.0, 0.0, 1e-11, 1e-4, 0.0])
    assert rig.scan is not None
    clock.t_s = rig.scan.end_s
    software.advance(clock.t_s)
    assert call("Scan.StatusGet", []) == (0,)
    assert "the scan does not begin: a frame of" in caplog.text
