"""Spikes in only one scan, and missing rows, don't move the result of the default estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmarks.drift.pairs import PIXEL_M, Pair, pair

from afspm.components import Array
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.pairs.images import Image, prepare
from afspm.plugins.drift.pairs.spikes import without_spikes
from afspm.plugins.drift.pairs.warp import COUNT, Scene
from afspm.plugins.drift.registration import DriftScan, Registration

PAIRS = [pair("stamper", "real", seed, prior_sd_px=3.0) for seed in range(40, 44)]  # alone, bars fit any others


def off_px(made: Pair, found: Registration) -> float:
    assert made.truth is not None
    assert found.accepted, found.reason
    return float(np.hypot(*(found.displacement_m - made.truth.at(found.center_m)))) / PIXEL_M


def rms_px(worse: dict[str, float], seed: int = 0) -> float:
    """Return the rms error over some pairs with these shares of spoiled pixels and rows."""
    random = np.random.default_rng(seed)

    def spoiled(scan: DriftScan) -> DriftScan:
        values = np.array(scan.values)
        spike = random.random(values.shape) < worse.get("spikes", 0.0)
        values[spike] += 3.0 * values.std() * random.standard_normal(int(spike.sum()))
        values[2:-2:10][random.random(len(values[2:-2:10])) < worse.get("rows", 0.0)] = np.nan
        return replace(scan, values=values)

    errors = [off_px(p, LeastSquares().register(spoiled(p.reference), spoiled(p.scan), p.prior)) for p in PAIRS]
    return float(np.sqrt(np.mean(np.square(errors))))


def test_spikes_and_missing_rows_add_little_to_the_error() -> None:
    assert rms_px({"spikes": 0.003, "rows": 0.6}) < 1.25 * rms_px({})


def scene(first: Array, second: Array) -> Scene:
    known = np.ones(first.shape, dtype=bool)
    return Scene(Image(first, known), Image(second, known))


def test_a_feature_of_both_scans_is_no_spike_and_a_spike_of_one_is_mended() -> None:
    random = np.random.default_rng(5)
    surface = np.zeros((64, 80))
    surface[20, 30] = surface[40, 61] = 1.0  # particles of one pixel, that the second scan sees 3 px to the right
    first, second = (s + 0.02 * random.standard_normal(s.shape) for s in (surface, np.roll(surface, 3, axis=1)))
    theta = np.zeros(COUNT)
    theta[0] = 3.0
    untouched = without_spikes(scene(first, second), theta)
    assert (untouched.first.values == first).all()
    assert (untouched.second.values == second).all()
    spoiled = second.copy()
    spoiled[10, 50] -= 1.0
    both = without_spikes(scene(first, spoiled), theta)
    assert (both.first.values == first).all()
    assert np.argwhere(both.second.values != spoiled).tolist() == [[10, 50]]
    assert abs(both.second.values[10, 50] - second[10, 50]) < 0.1


def test_a_single_missing_row_is_interpolated_from_its_neighbours() -> None:
    y, x = np.mgrid[:64, :64].astype(float)
    whole = np.sin(x / 5) * np.cos(y / 7)
    values = whole.copy()
    values[[12, 30, 31]] = np.nan
    found = prepare(values)
    assert np.flatnonzero(~found.known.all(axis=1)).tolist() == [30, 31]
    expected = prepare(whole).values[12]
    assert np.corrcoef(found.values[12], expected)[0, 1] > 0.99
