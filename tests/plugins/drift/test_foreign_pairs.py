"""The second generator of pairs: features lie at its truth, and its noise is there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmarks.drift import foreign_pairs
from benchmarks.drift.foreign_pairs import CELLS, HEIGHT_M, SURFACES, circumstances, foreign_pair, recorded
from benchmarks.drift.independent import ForeignTrial
from scipy import ndimage

from afspm.plugins.drift.estimators.least_squares import LeastSquares

QUIET: dict[str, Any] = {
    "white": 1e-6, "relaxing": (0.0, 0.0, 0.0), "hum": (0.0, 10.0), "offset": 0.0, "scars": 0.0, "spikes": 0.0,
    "lost": 0.0, "bow": 0.0, "step": 0.0, "flattening": "none", "creep_px": 0.0, "gain": 0.0, "bend": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("surface", "cell"), [*((s, "hard") for s in SURFACES), ("steps", "turned"), ("rough", "zoom20")]
)
def test_without_noise_the_truth_takes_one_scan_to_the_other(
    surface: str, cell: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        foreign_pairs, "circumstances", lambda name, random: replace(circumstances(name, random), **QUIET)
    )
    monkeypatch.setattr(foreign_pairs, "recorded", lambda values, how, random: values)
    made = foreign_pair(cell, surface, seed=3)
    xy_m = np.stack(made.reference.region.pixels_m(made.reference.values.shape))
    there_m = xy_m + np.apply_along_axis(made.displacement_m, 0, xy_m)
    scan = made.scan
    turn = scan.region.angle_rad
    apart = there_m - np.array(scan.region.center_m)[:, None, None]
    own = np.tensordot(np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]), apart, 1)
    at = [own[axis] / scan.pixel_m[axis] + (scan.values.shape[1 - axis] - 1) / 2 for axis in (1, 0)]
    seen = ndimage.map_coordinates(scan.values, at, order=5, mode="constant", cval=np.nan)
    difference = (seen - made.reference.values)[np.isfinite(seen)]
    assert difference.size > 150
    assert difference.std() < 0.06 * HEIGHT_M  # an atom of 5 px is read from its pixels to that


def test_mean_wander_of_a_frame_counts_as_displacement(monkeypatch: pytest.MonkeyPatch) -> None:
    """As for a tracker: the picture of the second frame lies where its lines were on average."""
    plain = foreign_pair("wander0.05", "rough", seed=5)
    moved = iter((0.0, 0.7))
    monkeypatch.setattr(foreign_pairs, "wander", lambda frame, *_: np.full((2, frame.pixels, 1), next(moved)))
    made = foreign_pair("wander0.05", "rough", seed=5)
    found = LeastSquares().register(made.reference, made.scan)
    off_px = (found.displacement_m - made.displacement_m(found.center_m)) / foreign_pairs.PIXEL_M
    assert np.hypot(*off_px) < 0.05
    assert np.hypot(*(made.displacement_px - plain.displacement_px)) > 0.5


def test_pairs_of_one_seed_are_the_same_and_of_another_are_not() -> None:
    first, again, other = (foreign_pair("real", "rough", seed) for seed in (1, 1, 2))
    assert np.array_equal(first.scan.values, again.scan.values, equal_nan=True)
    assert not np.array_equal(first.scan.values, other.scan.values, equal_nan=True)


def test_scars_are_one_to_three_rows_thick() -> None:
    random = np.random.default_rng(3)
    how = replace(circumstances("real", random), **{**QUIET, "scars": 0.03})
    thick = set()
    for _ in range(20):
        marked = np.abs(np.diff(recorded(np.zeros((64, 64)), how, random), axis=1)).max(axis=1) > 0.1
        _, runs = np.unique(ndimage.label(marked)[0][marked], return_counts=True)
        thick |= set(runs.tolist())
    assert {1, 2, 3} <= thick


def test_a_trial_judges_by_the_truth() -> None:
    for cell in ("real", "null"):
        assert cell in CELLS
        (outcome,) = ForeignTrial(cell, "particles", 5).run()
        assert outcome.accepted == (cell == "real")
        assert outcome.failed == (cell == "null")
