"""Blemishes in one of two scans, lines of a rotated scan, features of a pixel: effects on fit and ellipses."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.drift import foreign_pairs
from benchmarks.drift.foreign_pairs import PIXEL_M, foreign_pair

from afspm.components import Array
from afspm.plugins.drift.doubt.coefficients import SPREAD
from afspm.plugins.drift.doubt.covariance import Doubt
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.pairs.images import Image, without_scars
from afspm.plugins.drift.pairs.noise import CrossingLines
from afspm.plugins.drift.pairs.spikes import without_scars_of_one, without_spikes
from afspm.plugins.drift.pairs.warp import COUNT, OverlapBox, Scene, Spline, WarpedPair

SHIFT_PX = 3


def rough(seed: int = 4) -> Array:
    """Return ground on which a scar is no higher than its surroundings."""
    from scipy.ndimage import gaussian_filter

    made = gaussian_filter(np.random.default_rng(seed).standard_normal((80, 80)), 3.5)
    return np.asarray(made / made.std())


def seen_twice(noise: float = 0.03) -> tuple[Array, Array, Array]:
    """Return two views of a surface, the second `SHIFT_PX` to the right of the first, and theta."""
    whole, random = rough(), np.random.default_rng(1)
    first, second = (
        view + noise * random.standard_normal(view.shape) for view in (whole[:64, SHIFT_PX:67], whole[:64, :64])
    )
    theta = np.zeros(COUNT)
    theta[0] = SHIFT_PX
    return first, second, theta


def everywhere(values: Array) -> Image:
    return Image(values, np.ones(values.shape, dtype=bool))


@pytest.mark.parametrize("thick", [1, 2])
def test_a_scar_of_one_or_two_rows_is_mended_in_one_image(thick: int) -> None:
    y, x = np.mgrid[:64, :64].astype(float)
    surface = np.tanh((x + y - 60) / 6) + 0.02 * np.random.default_rng(8).standard_normal(x.shape)
    scarred = surface.copy()
    scarred[10 : 10 + thick, 12:40] += 0.7
    assert without_scars(surface) == pytest.approx(surface)
    assert abs(without_scars(scarred) - surface).max() < 0.25


@pytest.mark.parametrize("thick", [1, 2, 3])
def test_a_scar_of_one_scan_is_made_up_there_and_not_in_the_other(thick: int) -> None:
    first, second, theta = seen_twice()
    clean = first.copy()
    first[30 : 30 + thick, 20:50] += 0.8
    mended = without_scars_of_one(Scene(everywhere(first), everywhere(second)), theta)
    assert mended.second.made_up is None
    assert mended.first.made_up is not None
    rows = np.flatnonzero(mended.first.made_up.any(axis=1))
    assert rows.tolist() == list(range(30, 30 + thick))
    assert mended.first.made_up[30 : 30 + thick, 28:42].all()
    inside = np.s_[30 : 30 + thick, 28:42]
    assert abs(mended.first.values - clean)[inside].mean() < 0.8 * abs(first - clean)[inside].mean()


def test_made_up_pixels_carry_no_information_about_the_displacement() -> None:
    first, second, theta = seen_twice()
    made_up = np.zeros(first.shape, dtype=bool)
    made_up[30:33] = True
    scene = Scene(Image(first, ~np.zeros_like(made_up), made_up), everywhere(second))
    box = scene.box(theta[:2])
    assert box is not None
    _, _, known = WarpedPair(*scene.splines((first, second)), box).warped(theta)
    assert (~known).any(axis=1).sum() == 3


def test_scans_without_scars_stay_unchanged() -> None:
    first, second, theta = seen_twice()
    mended = without_scars_of_one(Scene(everywhere(first), everywhere(second)), theta)
    assert mended.first.values is first
    assert mended.second.values is second


@pytest.mark.parametrize("wide", [1, 2])
def test_a_spike_of_one_scan_is_mended_and_a_feature_of_both_is_left(wide: int) -> None:
    first, second, theta = seen_twice()
    for image, at in ((first, 40), (second, 40 + SHIFT_PX)):
        image[20, at : at + wide] += 4.0
    clean = first.copy()
    first[50, 30 : 30 + wide] += 5.0
    mended = without_spikes(Scene(everywhere(first), everywhere(second)), theta).first.values
    assert abs(mended - clean)[50, 28:34].max() < 1.0
    assert mended[20] == pytest.approx(clean[20])


def test_crossing_lines_are_removed_with_the_rows() -> None:
    """Offsets, tilts and bends of the rows of both scans are removed; features stay."""
    random, turn = np.random.default_rng(2), np.radians(30.0)
    x, y = np.meshgrid(np.arange(60.0) - 29.5, np.arange(60.0) - 29.5)
    own = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    lines = CrossingLines.of(*own)
    stripes = random.standard_normal((60, 1)) + random.standard_normal((60, 1)) * x / 30.0
    stripes += random.standard_normal(lines.number.max() + 1)[lines.number] * (1.0 + lines.along**2)
    everything = np.ones(x.shape)
    left = lines.seen(stripes[:, None], everything)[:, 0]
    assert left.std() < 0.05 * stripes.std()
    features = rough()[:60, :60]
    assert lines.seen(features[:, None], everything).std() > 0.4 * features.std()


def test_doubt_of_a_match_is_limited_to_the_range_of_the_fit() -> None:
    blocks = np.eye(COUNT)
    certain, small = Doubt(1.0, 1.0, 0.01, 0.1, blocks, 0.0), Doubt(1e4, 1e3, 3.0, 1.0, blocks, 0.0)
    assert certain.spread_of_evidence == pytest.approx(SPREAD["all"])
    assert small.spread_of_evidence == pytest.approx(SPREAD["most"])


@pytest.mark.parametrize("surface", ["rough", "particles", "steps"])
def test_ellipses_hold_the_errors_of_wandering_lines(surface: str) -> None:
    """The standard deviation given grows with the wander, and without wander it stays small."""
    sd_px = {}
    for cell in ("wander0.0", "wander0.2"):
        pairs = [foreign_pair(cell, surface, seed) for seed in range(50, 54)]
        found = [LeastSquares().register(one.reference, one.scan) for one in pairs]
        assert all(one.accepted for one in found)
        off_m = [one.displacement_m - pair.displacement_m(one.center_m) for one, pair in zip(found, pairs, strict=True)]
        chi2 = [off @ np.linalg.solve(one.covariance_m2, off) for one, off in zip(found, off_m, strict=True)]
        assert np.mean(chi2) / 2 < 3.0, "about one, of four pairs"
        sd_px[cell] = np.median([np.sqrt(np.trace(one.covariance_m2)) / PIXEL_M for one in found])
    assert sd_px["wander0.0"] < 0.04
    assert sd_px["wander0.2"] > 2.0 * sd_px["wander0.0"]


def test_wander_in_one_direction_leaves_the_other_as_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    wander = foreign_pairs.wander
    monkeypatch.setattr(foreign_pairs, "wander", lambda *how: wander(*how) * np.array([0.0, 1.0])[:, None, None])
    ratio = []
    for surface in ("rough", "particles", "lattice"):
        for seed in range(70, 73):
            pair = foreign_pair("wander0.2", surface, seed)
            found = LeastSquares().register(pair.reference, pair.scan)
            x, y = np.sqrt(np.diag(found.covariance_m2))
            ratio.append(x / y)
    assert np.median(ratio) < 0.5, "with one factor for both directions it is about one"


def test_lines_of_a_zoom_creep_for_their_own_pixels() -> None:
    """A tenth as wide they creep a tenth as far, for a tenth of the way; rotated ones are not modelled."""
    zoom, overview = Spline(np.zeros((20, 20)), None), Spline(np.zeros((120, 120)), None)
    box = OverlapBox.of_overlap((120, 120), (20, 20), np.zeros(2))
    assert box is not None
    theta, x = np.zeros(COUNT), np.ones((20, 20))
    theta[6] = 1.0

    def crept(own_px: tuple[float, float]) -> Array:
        pair = WarpedPair(overview, zoom, box, own_px=own_px)
        return np.asarray(pair.columns(x, x, x, x, free=[6])[0, 0])

    assert abs(crept((1.0, 1.0))[1]) > 0.5
    assert abs(crept((1.0, 0.1))[1]) < 0.02
    assert crept((0.0, 0.0)) == pytest.approx(np.zeros(20))


def test_ellipses_hold_the_errors_of_pictures_with_features_of_a_pixel() -> None:
    pairs = [foreign_pair("wander0.0", surface, seed) for surface in ("particles", "steps") for seed in range(60, 64)]
    found = [LeastSquares().register(one.reference, one.scan) for one in pairs]
    off_m = [one.displacement_m - pair.displacement_m(one.center_m) for one, pair in zip(found, pairs, strict=True)]
    chi2 = [off @ np.linalg.solve(one.covariance_m2, off) for one, off in zip(found, off_m, strict=True)]
    assert 0.1 < np.mean(chi2) / 2 < 2.0
