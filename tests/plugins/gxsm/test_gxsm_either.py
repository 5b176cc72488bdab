"""Tests for the emulated and a real GXSM: set AFSPM_GXSM to its address ("shm", "127.0.0.1:65431").

The tip moves and scans some nanometres at its place: use GXSM's own simulator (`-h SPM-SIM:SPM`), or withdraw.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.plugins.gxsm.gxsm_bench import Bench, hold_scan
from tests.plugins.vendor_bench import Peer, TranslatorProcess, scans, states

from afspm.basics import ExperimentClock
from afspm.model import ControlRequest, ControlResponse, Region, ScanParameters, ScopeState, names

FREE = ScopeState.FREE
REAL = "AFSPM_GXSM"
EMULATED: dict[str, dict[str, Any]] = {
    "simulator-3": {"card": "simulator", "version": 3},
    "simulator-4": {"card": "simulator", "transport": "shm"},
    "sranger": {},
    "rpspmc": {"card": "RPSPMC", "user_unit": "nm"},
}
FRAME = Region((10e-9, -5e-9), (50e-9, 30e-9), math.radians(20.0))
SHAPE = (24, 32)


@pytest.fixture(params=[*EMULATED, pytest.param("real", marks=pytest.mark.program)])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench | None]:
    """A bench with an emulated GXSM; None for the real one."""
    with ExitStack() as stack:
        yield Bench(tmp_path, stack, 5.0, EMULATED[request.param]) if request.param != "real" else None


@pytest.fixture
def peer(bench: Bench | None, tmp_path: Path) -> Iterator[Peer]:
    """A peer of a translator with a small frame; the previous settings are restored."""
    with ExitStack() as stack:
        if bench is not None:
            found = bench.start()
        else:
            address = os.environ.get(REAL)
            if not address:
                pytest.skip(f"{REAL} is not set: no real GXSM to ask")
            clock = ExperimentClock.real()
            found = TranslatorProcess(Bench.translator, {"address": address}, tmp_path, stack, clock).peer
        received = found.until(FREE)
        before = next(one for one in received if isinstance(one, ScanParameters))
        rate = found.get_response("x-pixel-rate")
        if rate.ok:  # GXSM's own simulator
            kept = found.get("x-pixel-rate")
            assert found.set("x-pixel-rate", 4000).ok
        in_force(found, ScanParameters(FRAME, SHAPE, ""))
        yield found
        in_force(found, before)
        if rate.ok:
            assert found.set("x-pixel-rate", kept).ok


def in_force(peer: Peer, wanted: ScanParameters) -> None:
    response = peer.ask(ControlRequest.SET_SCAN_PARAMS, wanted)
    assert response.ok, response.reason
    peer.until(lambda one: isinstance(one, ScanParameters) and one.shape == wanted.shape)
    peer.until(FREE)


def test_scan_of_a_rotated_oblong_frame(peer: Peer) -> None:
    assert peer.act(names.START_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["SCANNING", "FREE"]
    found = scans(received)
    assert found
    for scan in found:
        assert scan.region == Region.from_top_left(FRAME.top_left_m, FRAME.size_m, FRAME.angle_rad)
        assert scan.shape == SHAPE
        assert np.isfinite(scan.values).all()
    topography = next(scan for scan in found if "Topo" in scan.channel)
    assert topography.unit == "m"
    assert 0.0 < np.ptp(topography.values) < 1e-6


def test_stopped_scan(peer: Peer, bench: Bench | None) -> None:
    if bench is not None:
        bench.at_panel(lambda emulator: hold_scan(emulator.program, 1))
    assert peer.act(names.START_SCAN).ok
    peer.until(ScopeState.SCANNING)
    assert peer.set(names.SCAN_SIZE_X, 60e-9).code == ControlResponse.NOT_FREE
    assert peer.act(names.STOP_SCAN).ok
    received = peer.until(FREE)
    assert states(received) == ["INTERRUPTED", "FREE"]
    assert not scans(received)


def test_parameters_are_as_they_were_set(peer: Peer) -> None:
    for name, value, unit in (
        (names.SCAN_TOP_LEFT_X, "-12.5", "nm"),
        (names.SCAN_SIZE_Y, "25.25", "nm"),
        (names.SCAN_RESOLUTION_Y, "20", None),
        (names.SCAN_ANGLE, "-7.5", "deg"),
    ):
        response = peer.set(name, value, unit)
        assert response.ok, (name, response.reason)
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(50e-9, rel=1e-6)
    assert peer.get(names.SCAN_RESOLUTION_X) == "32"
    before = float(peer.get(names.TIP_BIAS_VOLTAGE))
    assert peer.set(names.TIP_BIAS_VOLTAGE, before / 2).ok
    assert float(peer.get(names.TIP_BIAS_VOLTAGE)) == pytest.approx(before / 2)
    assert peer.set(names.TIP_BIAS_VOLTAGE, before).ok


def test_invalid_values_are_refused(peer: Peer) -> None:
    assert peer.set(names.SCAN_SIZE_X, "nan").code == ControlResponse.PARAM_ERROR
    assert peer.set(names.SCAN_SIZE_X, 1, "V").code == ControlResponse.PARAM_ERROR
    assert peer.set(names.SCAN_SIZE_X, -1e-9).code == ControlResponse.PARAM_ERROR
    assert peer.set("x-nonsense", 1).code == ControlResponse.PARAM_NOT_SUPPORTED
    assert peer.act("x-nonsense").code == ControlResponse.ACTION_NOT_SUPPORTED
    assert float(peer.get(names.SCAN_SIZE_X)) == pytest.approx(50e-9, rel=1e-6)
