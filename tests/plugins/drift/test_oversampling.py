"""Scans with smaller pixels than their features need: fitted with pixels twice as large, with the same result."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.pairs import oversampling
from afspm.plugins.drift.pairs.images import onto_common_grid, prepare
from afspm.plugins.drift.pairs.oversampling import with_larger_pixels
from afspm.plugins.drift.pairs.warp import COUNT, Scene
from afspm.plugins.drift.registration import DriftScan, Registration

MOVED_PX = np.array([7.0, -4.0])


def _scans(size: tuple[int, int], blurred_px: float, seed: int = 1) -> tuple[DriftScan, DriftScan]:
    # one surface and two frames of it, pixels of 1 nm, at the same scanner position
    random = np.random.default_rng(seed)
    ny, nx = size
    surface = gaussian_filter(random.standard_normal((ny + 16, nx + 16)), blurred_px)
    surface /= surface.std()
    region = Region((0.0, 0.0), ((nx - 1) * 1e-9, (ny - 1) * 1e-9))
    x, y = MOVED_PX.astype(int)
    frames = surface[8 : 8 + ny, 8 : 8 + nx], surface[8 - y : 8 - y + ny, 8 - x : 8 - x + nx]
    first, second = (
        DriftScan(frame + 0.1 * random.standard_normal(size), region, 1000.0 * k, 1000.0 * k + 100.0)
        for k, frame in enumerate(frames)
    )
    return first, second


def _shape_of_fit(first: DriftScan, second: DriftScan, theta: Array | None = None) -> tuple[int, int]:
    grid, *images = onto_common_grid(first, prepare(first.values), second, prepare(second.values))
    start = np.concatenate([MOVED_PX, np.zeros(COUNT - 2)]) if theta is None else theta
    scene, *_ = with_larger_pixels(Scene(*images), grid, start)
    ny, nx = scene.first.values.shape
    return ny, nx


def _off_px(found: Registration) -> Array:
    return np.asarray(np.abs(found.displacement_m / 1e-9 - MOVED_PX))


def test_features_over_many_pixels_are_fitted_with_larger_ones() -> None:
    assert _shape_of_fit(*_scans((256, 256), 5.0)) == (128, 128)
    assert _shape_of_fit(*_scans((512, 520), 8.0)) == (128, 130)


def test_sharp_features_keep_their_pixels() -> None:
    assert _shape_of_fit(*_scans((256, 256), 1.2)) == (256, 256)


def test_small_images_keep_their_pixels() -> None:
    assert _shape_of_fit(*_scans((254, 400), 5.0)) == (254, 400)


def test_unrelated_scans_prove_nothing_and_keep_their_pixels() -> None:
    first, _ = _scans((256, 256), 1.2, seed=2)
    _, second = _scans((256, 256), 1.2, seed=3)
    assert _shape_of_fit(first, second) == (256, 256)


@pytest.mark.parametrize("size", [(256, 256), (257, 259)])
def test_larger_pixels_give_the_same_displacement(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = _scans(size, 5.0)
    halved = LeastSquares().register(first, second)
    monkeypatch.setattr(oversampling, "LEAST_HALVED_PX", 1000)
    whole = LeastSquares().register(first, second)
    assert halved.accepted
    assert whole.accepted
    assert (_off_px(halved) < 0.03).all()
    assert (np.abs(halved.displacement_m - whole.displacement_m) < 0.02e-9).all()
    assert np.abs(halved.center_m - whole.center_m).max() < 2e-9
    deviations = (np.sqrt(np.diag(one.covariance_m2)) for one in (halved, whole))
    assert 0.5 < np.divide(*deviations).max() < 2.0


def test_unmeasured_rows_stay_unmeasured() -> None:
    first, second = _scans((256, 256), 5.0)
    values = second.values.copy()
    values[130:] = np.nan
    stopped = DriftScan(values, second.region, second.start_s, second.end_s)
    found = LeastSquares().register(first, stopped)
    assert found.accepted
    assert (_off_px(found) < 0.05).all()
