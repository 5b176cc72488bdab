"""The wait after a move of the frame, with the simulated scanner whose z has yet to settle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm.model import ControlRequest, ControlResponse, Region, Scan, ScanParameters, names
from afspm.simulation.scan_drawing import run_at_once
from afspm.simulation.simulator import Simulator

NOISE: dict[str, object] = {"white_m": 1e-12, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}
THERE = ScanParameters(Region.from_top_left((0.2e-6, 0.0), (64e-9, 64e-9)), (64, 16))


def bent_m(make_bench: Any, folder: Path, settle_s: float) -> float:
    """Return how far the first lines of a scan after a move are off the straight line of the last ones, in m."""
    made = Simulator(
        surface="flat", scanner="stm-4k", noise=NOISE, initial={"scan-speed": "128 nm/s"}, settle_before_scan_s=settle_s
    )
    made.run_drawing = run_at_once  # type: ignore[method-assign]
    bench = make_bench()
    bench.microscope, bench.folder = made, folder
    bench.start()
    assert bench.ask(ControlRequest.SET_SCAN_PARAMS, THERE).code == ControlResponse.SUCCESS
    for _ in range(200):
        if bench.ask(ControlRequest.ACTION, names.START_SCAN).code == ControlResponse.SUCCESS:
            break
        bench.look(after_s=0.25)
    for _ in range(200):
        bench.look(after_s=0.5)
    heights = next(one for _, one, _ in bench.port.packets if isinstance(one, Scan) and one.channel == "Height")
    lines = heights.values.mean(axis=1)
    assert len(lines) == 64
    rows = np.arange(64)
    steady = np.polyval(np.polyfit(rows[32:], lines[32:], 1), rows)  # the drift of z
    return float(np.abs(lines - steady).max())


def test_first_lines_get_straighter_when_the_scanner_settles(make_bench: Any, tmp_path: Path) -> None:
    # results C38: after a move by 234 nm z is off by 100 pm, as at the instrument that the scanner is like
    folders = [tmp_path / str(number) for number in range(3)]
    for folder in folders:
        folder.mkdir()
    waits_s = (0.0, 5.0, 30.0)
    at_once, after_5_s, after_30_s = (bent_m(make_bench, *one) for one in zip(folders, waits_s, strict=True))
    assert at_once == pytest.approx(100e-12, rel=0.1)
    assert after_5_s == pytest.approx(0.61 * at_once, rel=0.1)
    assert after_30_s < 0.1 * at_once
