"""The default estimator: displacement in metres, and refusals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan, Prior, Registration

NM = 1e-9
SIZE_M = 1e-6
DRIFT_M = np.array([31.3 * NM, -18.9 * NM])


def surface(x_m: NDArray[np.float64], y_m: NDArray[np.float64], seed: int = 1) -> NDArray[np.float64]:
    """A smooth random relief, known everywhere: 150 waves of 40 nm and more, the longer the higher."""
    random = np.random.default_rng(seed)
    k = 2 * np.pi * random.uniform(1, 25, 150) / SIZE_M
    angle, phase = random.uniform(0, 2 * np.pi, (2, 150))
    waves = np.zeros_like(x_m)
    for k_i, a_i, p_i in zip(k, angle, phase, strict=True):
        waves += np.cos(k_i * (x_m * np.cos(a_i) + y_m * np.sin(a_i)) + p_i) * (k[0] / k_i)
    return NM * waves


def scanned(
    region: Region,
    shape: tuple[int, int] = (96, 96),
    drift_m: NDArray[np.float64] | tuple[float, float] = (0.0, 0.0),
    seed: int = 1,
    noise: float = 0.02,
    start_s: float = 0.0,
) -> DriftScan:
    """Return a scan of a surface that has moved by `drift_m` under the tip, with noise as a share of the relief."""
    x, y = region.pixels_m(shape)
    values = surface(x - drift_m[0], y - drift_m[1], seed)
    values += noise * values.std() * np.random.default_rng([seed, 7, int(start_s)]).standard_normal(shape)
    return DriftScan(values, region, start_s, start_s + 100.0, upwards=True)


REGION = Region((0.0, 0.0), (SIZE_M, SIZE_M))
PIXEL_M = SIZE_M / 95


def registered(scan: DriftScan, reference: DriftScan | None = None, prior: Prior | None = None) -> Registration:
    return LeastSquares().register(reference or scanned(REGION), scan, prior)


def assert_displaced(
    found: Registration, expected_m: NDArray[np.float64], within_m: float, sd_m: float | None = None
) -> None:
    assert found.accepted, found.reason
    assert np.abs(found.displacement_m - expected_m).max() < within_m
    assert found.sd_m < (within_m if sd_m is None else sd_m)


def test_a_feature_is_found_where_the_drift_took_it() -> None:
    assert_displaced(registered(scanned(REGION, drift_m=DRIFT_M, start_s=900.0)), DRIFT_M, 0.2 * NM)


def test_the_centre_of_the_scan_is_taken_into_account() -> None:
    """A scan that followed the drift shows the same picture; the feature has moved all the same."""
    moved = REGION.moved_to((float(DRIFT_M[0]), float(DRIFT_M[1])))
    assert_displaced(registered(scanned(moved, drift_m=DRIFT_M, start_s=900.0)), DRIFT_M, 0.2 * NM)


def test_pixels_that_are_not_square_are_registered() -> None:
    wide = Region((0.0, 0.0), (1.5 * SIZE_M, SIZE_M))
    reference, scan = scanned(wide, (128, 80)), scanned(wide, (128, 80), DRIFT_M, start_s=900.0)
    assert_displaced(registered(scan, reference), DRIFT_M, 0.3 * NM)


@pytest.mark.parametrize("angle_deg", [30.0, 90.0, -135.0])
def test_rotated_frames_are_registered(angle_deg: float) -> None:
    turned = Region((0.0, 0.0), (SIZE_M, SIZE_M), math.radians(angle_deg))
    assert_displaced(registered(scanned(turned, drift_m=DRIFT_M, start_s=9.0), scanned(turned)), DRIFT_M, 0.2 * NM)


@pytest.mark.parametrize(
    ("region", "shape", "within_m"),
    [
        (Region((0.0, 0.0), (SIZE_M, SIZE_M)), (160, 160), 0.5 * NM),
        (Region((0.0, 0.0), (SIZE_M, SIZE_M)), (70, 110), 0.5 * NM),
        (Region((0.1e-6, 0.05e-6), (0.7 * SIZE_M, 0.7 * SIZE_M)), (96, 96), 0.5 * NM),
        # Rows that lie across each other can't be freed of the same lines: that costs accuracy, and looks like wander.
        (Region((0.0, 0.0), (SIZE_M, SIZE_M), math.radians(25.0)), (96, 96), 2.0 * NM),
        (Region((0.0, 0.0), (SIZE_M, SIZE_M), math.radians(90.0)), (96, 80), 2.0 * NM),
    ],
    ids=["finer", "other pixels", "smaller", "turned", "turned with pixels that are not square"],
)
def test_scans_of_different_geometry_are_registered(region: Region, shape: tuple[int, int], within_m: float) -> None:
    scan = scanned(region, shape, DRIFT_M, start_s=900.0)
    sd_m = PIXEL_M if region.angle_rad else within_m
    assert_displaced(registered(scan), DRIFT_M, within_m, sd_m)
    assert_displaced(registered(scanned(REGION), scan), -DRIFT_M, within_m, sd_m)


def test_centre_and_linear_part_give_the_place_of_any_feature() -> None:
    stretch = np.array([[0.004, -0.003], [0.002, 0.001]])
    x, y = REGION.pixels_m((128, 128))
    reference = DriftScan(surface(x, y), REGION, 0.0, 100.0)
    back_x, back_y = np.tensordot(np.linalg.inv(np.eye(2) + stretch), np.stack([x, y]) - DRIFT_M[:, None, None], 1)
    found = registered(DriftScan(surface(back_x, back_y), REGION, 900.0, 1000.0), reference)
    assert found.accepted, found.reason
    for at_m in np.array([[0.0, 0.0], [0.3, 0.1], [-0.2, 0.35]]) * 1e-6:
        displaced_m = found.displacement_m + found.linear @ (at_m - found.center_m)
        assert displaced_m == pytest.approx(DRIFT_M + stretch @ at_m, abs=0.2 * NM)


def test_a_scan_stopped_half_way_is_registered_by_its_measured_rows() -> None:
    scan = scanned(REGION, drift_m=DRIFT_M, start_s=900.0)
    values = scan.values.copy()
    values[60:] = np.nan
    assert_displaced(registered(DriftScan(values, REGION, 900.0, 960.0)), DRIFT_M, 0.4 * NM)
    values[60:] = 0.0
    assert_displaced(registered(DriftScan(values, REGION, 900.0, 960.0)), DRIFT_M, 0.4 * NM)


def test_the_prior_is_a_displacement_in_tip_coordinates() -> None:
    turned = Region((1e-7, 2e-7), (SIZE_M, SIZE_M), math.radians(40.0))
    scan, reference = scanned(turned, drift_m=DRIFT_M, start_s=900.0), scanned(REGION)
    right = Prior(DRIFT_M + 5 * NM, np.eye(2) * (8 * NM) ** 2)
    assert_displaced(registered(scan, reference, right), DRIFT_M, 1.0 * NM, PIXEL_M)
    assert not registered(scan, reference, Prior(-4 * DRIFT_M, np.eye(2) * (5 * NM) ** 2)).accepted


def _values(kind: str) -> NDArray[np.float64]:
    values = scanned(REGION).values.copy()
    random = np.random.default_rng(3)
    if kind == "not measured":
        values[:] = np.nan
    elif kind == "a few rows measured":
        values[7:] = np.nan
    elif kind == "constant":
        values[:] = 3e-9
    elif kind == "tilted rows alone":
        values[:] = random.standard_normal((96, 1)) + np.linspace(0, 1, 96) * random.standard_normal((96, 1))
    elif kind == "noise alone":
        values = random.standard_normal((96, 96))
    elif kind == "saturated":
        values = np.minimum(values, np.quantile(values, 0.3))
    return values


@pytest.mark.parametrize(
    "measured", [np.s_[:24], np.s_[60:], np.s_[:, :40]], ids=["first rows", "last rows", "columns"]
)
def test_a_part_of_a_scan_is_registered(measured: slice | tuple[slice, slice]) -> None:
    whole = scanned(REGION, drift_m=DRIFT_M, start_s=900.0)
    values = np.full_like(whole.values, np.nan)
    values[measured] = whole.values[measured]
    assert_displaced(registered(replace(whole, values=values)), DRIFT_M, 1.0 * NM, 2.0 * PIXEL_M)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("not measured", "only 0 of 96 rows"),
        ("a few rows measured", "only 7 of 96 rows"),
        ("constant", "only 0 of 96 rows|all values of the scan are equal"),
        ("tilted rows alone", "an offset and a tilt"),
        ("noise alone", "noise or streaks"),
        ("saturated", "saturated"),
    ],
)
def test_a_scan_without_information_is_refused_with_the_reason(kind: str, reason: str) -> None:
    import re

    scan = DriftScan(_values(kind), REGION, 900.0, 1000.0)
    for found in (registered(scan), registered(scanned(REGION), scan)):
        assert not found.accepted
        assert re.search(reason, found.reason)


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_scans_of_different_places_are_refused(seed: int) -> None:
    found = registered(scanned(REGION, seed=seed))
    assert not found.accepted
    assert found.reason


def test_two_like_features_are_distinguished_by_a_prediction() -> None:
    """The reference shows both, 600 nm apart, and the scan one of them; its empty surroundings are not enough."""
    drift_m = np.array([250 * NM, 20 * NM])

    def bumps(moved_m: NDArray[np.float64], start_s: float) -> DriftScan:
        x, y = REGION.pixels_m((96, 96))
        away = [np.hypot(x - moved_m[0] - at, 1.3 * (y - moved_m[1])) for at in (-300 * NM, 300 * NM)]
        values = sum(NM / (1.0 + np.exp((r - 120 * NM) / (8 * NM))) for r in away)
        noise = 0.02 * NM * np.random.default_rng(int(start_s)).standard_normal(values.shape)
        return DriftScan(values + noise, REGION, start_s, start_s + 100.0, upwards=True)

    reference, scan = bumps(np.zeros(2), 0.0), bumps(drift_m, 900.0)
    found = registered(scan, reference)
    assert not found.accepted
    assert "another displacement explains" in found.reason
    assert np.abs(found.displacement_m - drift_m).max() < 2 * NM
    known = registered(scan, reference, Prior(drift_m + 10 * NM, (30 * NM) ** 2 * np.eye(2)))
    assert_displaced(known, drift_m, 2 * NM)


def test_a_scan_is_registered_with_itself_exactly() -> None:
    values = np.random.default_rng(3).normal(size=(64, 64)).cumsum(0).cumsum(1)
    scan = DriftScan(values, Region((0, 0), (1e-6, 1e-6)), 0.0, 1.0)
    found = LeastSquares().register(scan, scan)
    assert found.accepted, found.reason
    assert found.displacement_m == pytest.approx([0.0, 0.0], abs=1e-15)


def test_an_expected_lattice_site_like_all_others_is_refused() -> None:
    """One site off nearly everything fits; the comparison with other sites shows that the defects don't."""
    period_m, cos, sin = 140 * NM, math.cos(0.5), math.sin(0.5)
    x, y = REGION.pixels_m((96, 96))
    defects = np.random.default_rng(5).uniform(-SIZE_M / 2, SIZE_M / 2, (12, 2))

    def lattice(moved_m: NDArray[np.float64], start_s: float) -> DriftScan:
        u, v = x - moved_m[0], y - moved_m[1]
        along, across = u * cos + v * sin, v * cos - u * sin
        values = np.cos(2 * np.pi * along / period_m) + np.cos(2 * np.pi * across / period_m)
        values += sum(2.0 * np.exp(-((u - p) ** 2 + (v - q) ** 2) / (40 * NM) ** 2) for p, q in defects)
        noise = 0.5 * np.random.default_rng(int(start_s)).standard_normal(values.shape)
        return DriftScan(NM * (values + noise), REGION, start_s, start_s + 100.0, upwards=True)

    def expecting(displacement_m: NDArray[np.float64]) -> Registration:
        prior = Prior(displacement_m, (15 * NM) ** 2 * np.eye(2))
        return registered(lattice(DRIFT_M, 900.0), lattice(np.zeros(2), 0.0), prior)

    assert_displaced(expecting(DRIFT_M), DRIFT_M, 2 * NM)
    wrong = expecting(DRIFT_M + period_m * np.array([cos, sin]))
    assert not wrong.accepted
    assert "a site like the others" in wrong.reason


def test_scans_of_twelve_pixels_are_registered_within_their_uncertainty() -> None:
    first, second = (scanned(REGION, (12, 12), start_s=start_s) for start_s in (0.0, 900.0))
    found = registered(second, first)
    assert np.hypot(*found.displacement_m) < 3.0 * found.sd_m
    assert "too small" not in found.reason


def test_a_small_overlap_is_registered_where_a_displacement_is_expected() -> None:
    first, second = (scanned(REGION, (12, 12), start_s=start_s) for start_s in (0.0, 900.0))
    found = registered(second, first, Prior(np.zeros(2), (20 * NM) ** 2 * np.eye(2)))
    assert "too small" not in found.reason
    assert np.isfinite(found.sd_m)
