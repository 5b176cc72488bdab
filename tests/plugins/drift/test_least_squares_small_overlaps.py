"""The default estimator on small overlaps: zooms into an overview, down to the smallest overlap that it accepts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from rotation import rotated

from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan, Prior

pytestmark = pytest.mark.slow

PIXEL_M = 40e-9
OVERVIEW = Region((0.0, 0.0), (63 * PIXEL_M, 63 * PIXEL_M))
DRIFT_M = np.array([0.7, -0.4]) * PIXEL_M


def smooth(x_m: NDArray[np.float64], y_m: NDArray[np.float64], longest_px: float, seed: int) -> NDArray[np.float64]:
    """Return a relief of some long waves: few features, and gradients alike everywhere."""
    random = np.random.default_rng(seed)
    height = np.zeros_like(x_m)
    for _ in range(6):
        length_m, turn = PIXEL_M * random.uniform(0.4, 1.0) * longest_px, random.uniform(0.0, 2 * np.pi)
        along_m = x_m * np.cos(turn) + y_m * np.sin(turn)
        height += np.cos(2 * np.pi * along_m / length_m + random.uniform(0.0, 2 * np.pi))
    return height


def scanned(region: Region, pixels: int, longest_px: float, noise: float, seed: int, start_s: float) -> DriftScan:
    x, y = region.pixels_m((pixels, pixels))
    moved_m = DRIFT_M if start_s else np.zeros(2)
    values = smooth(x - moved_m[0], y - moved_m[1], longest_px, seed)
    values += noise * np.random.default_rng([seed, int(start_s)]).standard_normal(values.shape)
    return DriftScan(values, region, start_s, start_s + 100.0, upwards=True)


@pytest.mark.parametrize("longest_px", [12.0, 40.0, 150.0])
@pytest.mark.parametrize("zoom_px", rotated(range(8, 25), 4))
def test_a_zoom_of_any_size_and_resolution_never_raises(zoom_px: int, longest_px: float) -> None:
    for seed, pixels in enumerate((zoom_px + 1, 2 * zoom_px, 128)):
        random = np.random.default_rng([zoom_px, int(longest_px), pixels])
        noise = float(random.choice((0.0, 1e-3, 0.05)))
        middle_m = random.uniform(-0.5, 0.5, 2) * (63 - zoom_px - 2) * PIXEL_M
        zoom = Region((float(middle_m[0]), float(middle_m[1])), (zoom_px * PIXEL_M, zoom_px * PIXEL_M))
        reference = scanned(OVERVIEW, 64, longest_px, noise, seed, 0.0)
        scan = scanned(zoom, pixels, longest_px, noise, seed, 900.0)
        prior = Prior(DRIFT_M + random.normal(0.0, PIXEL_M, 2), (1.5 * PIXEL_M) ** 2 * np.eye(2))
        for one, two in ((reference, scan), (scan, reference), (scan, scan)):
            for expected in (None, prior):
                found = LeastSquares().register(one, two, expected)
                assert found.reason or np.linalg.eigvalsh(found.covariance_m2)[0] > 0.0


def test_a_doubtful_match_is_accepted_only_where_it_was_expected() -> None:
    zoom = Region((0.0, 0.0), (20 * PIXEL_M, 20 * PIXEL_M))
    reference, scan = scanned(OVERVIEW, 64, 40.0, 0.05, 1, 0.0), scanned(zoom, 64, 40.0, 0.05, 1, 900.0)
    prior = Prior(DRIFT_M, (1.5 * PIXEL_M) ** 2 * np.eye(2))
    wrong = LeastSquares().register(reference, scan, prior).quality["wrong"]
    assert LeastSquares(wrong_at_most=min(0.6 * wrong, 0.9)).register(reference, scan, prior).accepted
    blind = LeastSquares().register(reference, scan).quality["wrong"]
    assert not LeastSquares(wrong_at_most=0.6 * blind).register(reference, scan).accepted
