"""Pairs of the drift benchmark without noise."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmarks.drift import cuts, families
from scipy import ndimage

from afspm.components import Array
from afspm.plugins.drift.registration import DriftScan

QUIET: dict[str, Any] = {
    "white": 0.0,
    "row_offset": 0.0,
    "one_over_f": 0.0,
    "scars": 0.0,
    "tilt": 0.0,
    "flatten": None,
    "row_tilt": 0.0,
    "spikes": 0.0,
    "lost": 0.0,
    "bow": 0.0,
    "creep_px": 0.0,
    "gain": 1.0,
    "bend": 0.0,
}


def found_at(scan: DriftScan, xy_m: Array) -> Array:
    """Return heights at positions (2, …) in tip coordinates, interpolated from the scan's pixels."""
    ny, nx = scan.values.shape
    x_m, y_m = scan.region.pixels_m((ny, nx))
    column = (xy_m[0] - x_m[0, 0]) / scan.pixel_m[0]
    row = (xy_m[1] - y_m[0, 0]) / scan.pixel_m[1]
    return np.asarray(ndimage.map_coordinates(scan.values, [row, column], order=5, mode="constant", cval=np.nan))


def require_match_at_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut a pair without noise, and require one scan, moved by the truth, to be the other."""
    drawn = families.drawn_condition
    quiet = {**QUIET, "scars": 0.0}
    monkeypatch.setattr(cuts, "drawn_condition", lambda name, random: replace(drawn(name, random), **quiet))
    monkeypatch.setattr(cuts, "_noise", lambda half, random: np.zeros((cuts.PIXELS, cuts.PIXELS)))
    made = cuts.cut("real", 2, "unseen")
    assert made.truth is not None
    x_m, y_m = made.reference.region.pixels_m(made.reference.values.shape)
    there_m = np.stack([x_m, y_m]) + np.apply_along_axis(made.truth.at, 0, np.stack([x_m, y_m]))
    moved = found_at(made.scan, there_m)
    seen = np.isfinite(moved)
    assert np.corrcoef(moved[seen], made.reference.values[seen])[0, 1] > 0.999
