"""The bands of [conditions], read for drawings, and gaps of long curves."""

from __future__ import annotations

import math
from pathlib import Path

from afspm.drawing.timeline import DrawnBand
from afspm.model import ProblemNames
from afspm.night.overview import Overview
from afspm.night.reading_curves import MOST_POINTS, ReadingCurve, instrument_curves
from afspm.record.allowed_bands import allowed_bands
from afspm.record.run_json import EXPERIMENT_FILE


def test_bands_of_the_experiment_file_are_in_the_units_of_the_curves(tmp_path: Path) -> None:
    (tmp_path / EXPERIMENT_FILE).write_text(
        """
        [conditions.cold]
        "cryo.temperature" = { from = "4150 mK", to = "4.25 K", for = "60 s" }
        while = ["start-scan"]
        [conditions.settled]
        "cryo.temperature" = { within = "10 mK" }
        "magnet.field" = { from = "1.9 T" }
        [conditions.wrong]
        "gas.pressure" = { from = "much" }
        """,
        encoding="utf-8",
    )
    overview = Overview(ProblemNames())
    for name, unit in (("cryo.temperature", "K"), ("magnet.field", "T"), ("gas.pressure", "Pa")):
        overview.instruments[name] = ReadingCurve(unit, [0], [1.0])
    bands = {one.name: one.bands for one in instrument_curves(overview.instruments, allowed_bands(tmp_path))}
    assert bands == {
        "cryo.temperature": [DrawnBand("cold", 4.15, 4.25)],
        "gas.pressure": [],
        "magnet.field": [DrawnBand("settled", 1.9, math.inf)],
    }


def test_run_without_an_experiment_file_has_no_bands(tmp_path: Path) -> None:
    assert allowed_bands(tmp_path) == {}


def test_thinned_curve_keeps_its_gaps() -> None:
    curve = ReadingCurve()
    for k in range(2 * MOST_POINTS):
        curve.add(k * 10**9, math.nan if k == 1001 else 4.2)
    assert any(map(math.isnan, curve.values))
