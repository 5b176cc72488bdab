"""The default estimator knows its own error, and uses a known drift velocity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from afspm.model import Region
from afspm.plugins.drift.doubt.covariance import mean_over_rows
from afspm.plugins.drift.doubt.nuisances import Shear, averaged
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.pairs.images import without_scars
from afspm.plugins.drift.pairs.noise import denoised
from afspm.plugins.drift.pairs.warp import COUNT, derivative
from afspm.plugins.drift.registration import DriftScan, Prior
from afspm.plugins.drift.registration.alignment import Believed, Fit
from afspm.plugins.drift.registration.search import shear_by_drift

NM = 1e-9
PIXEL_M = 10 * NM
REGION = Region((0.0, 0.0), (63 * PIXEL_M, 63 * PIXEL_M))


def waves(x_m: NDArray[np.float64], y_m: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    random = np.random.default_rng(seed)
    height: NDArray[np.float64] = np.zeros_like(x_m)
    for _ in range(80):
        kx, ky = 2 * np.pi * random.uniform(-1, 1, 2) / (8 * PIXEL_M)
        height += np.cos(kx * x_m + ky * y_m + random.uniform(0, 2 * np.pi)) / (1 + 1e-15 * (kx**2 + ky**2))
    even: NDArray[np.float64] = height / height.std()
    return even


def scanned(
    heights: NDArray[np.float64], noise: float, seed: int, region: Region = REGION, upwards: bool | None = True
) -> DriftScan:
    random = np.random.default_rng([seed, 5])
    values = heights + noise * random.standard_normal(heights.shape)
    values += 0.3 * random.standard_normal((heights.shape[0], 1))
    return DriftScan(values, region, 100.0 * seed, 100.0 * seed + 60.0, upwards=upwards)


def test_the_truth_lies_in_the_ellipse_as_often_as_it_says() -> None:
    x, y = REGION.pixels_m((64, 64))
    chi2 = []
    for seed in range(40):
        drift_m = np.random.default_rng([seed, 9]).uniform(-60, 60, 2) * NM
        first, second = waves(x, y, seed), waves(x - drift_m[0], y - drift_m[1], seed)
        found = LeastSquares().register(scanned(first, 0.15, 2 * seed), scanned(second, 0.15, 2 * seed + 1))
        assert found.accepted, found.reason
        off_m = found.displacement_m - drift_m
        chi2.append(float(off_m @ np.linalg.solve(found.covariance_m2, off_m)))
    inside = np.mean(np.array(chi2) < 5.99)
    assert inside >= 0.85
    assert 0.4 < np.mean(chi2) < 3.0, "2 is expected of two normal numbers"


def test_more_noise_is_more_uncertainty() -> None:
    x, y = REGION.pixels_m((64, 64))
    first, second = waves(x, y, 3), waves(x - 22 * NM, y + 13 * NM, 3)
    sds_m = [LeastSquares().register(scanned(first, noise, 1), scanned(second, noise, 2)).sd_m for noise in (0.03, 0.3)]
    assert 3.0 < sds_m[1] / sds_m[0] < 30.0


def edge(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the end of one bump: its shift and its shear are nearly the same."""
    along, across = x_m + 100 * NM, y_m - 120 * NM
    inside = 150 * NM - np.hypot(np.maximum(along, 0.0), across)
    return 1.0 / (1.0 + np.exp(-inside / (10 * NM)))


def test_a_known_drift_velocity_brings_shift_and_shear_nearer_to_the_truth() -> None:
    x, y = REGION.pixels_m((64, 64))
    shear, drift_m = 0.02, np.array([12 * NM, 7 * NM])
    velocity_m_s = np.array([shear * REGION.size_m[1] / 60.0, 0.0])
    expected = drift_m, np.eye(2) * (200 * NM) ** 2
    priors = Prior(*expected), Prior(*expected, velocity_m_s, 0.002 * velocity_m_s[0])
    found = []
    for seed in range(0, 16, 2):
        reference = scanned(edge(x, y), 0.05, seed)
        scan = scanned(edge(x - drift_m[0] - shear * y, y - drift_m[1]), 0.05, seed + 1)
        for each in (LeastSquares().register(reference, scan, prior) for prior in priors):
            found.append((np.hypot(*(each.displacement_m - drift_m)), each.linear[0, 1] - shear))
    guessed, known = np.sqrt(np.mean(np.square(np.reshape(found, (8, 2, 2))), axis=0))
    assert (known < 0.85 * guessed).all(), "of shift and shear (which is not exact: a turn shears too, and is unknown)"


def prior(velocity_m_s: tuple[float, float], sd_m_s: float | None = 1e-12) -> Prior:
    return Prior(np.zeros(2), np.eye(2), np.array(velocity_m_s), sd_m_s)


def scan_taken(upwards: bool | None, angle_rad: float = 0.0, duration_s: float = 60.0) -> DriftScan:
    region = Region((0.0, 0.0), (1e-6, 2e-6), angle_rad)
    return DriftScan(np.zeros((8, 8)), region, 0.0, duration_s, upwards=upwards)


@pytest.mark.parametrize(("upwards", "sign"), [(True, 1.0), (False, -1.0)])
def test_drift_shears_along_the_slow_axis_in_the_direction_of_time(upwards: bool, sign: float) -> None:
    mean, sd = shear_by_drift(prior((1e-10, -2e-10)), scan_taken(upwards), scan_taken(upwards))
    assert mean == pytest.approx(sign * np.array([1e-10, -2e-10]) * 60.0 / 2e-6)
    assert sd == pytest.approx(1e-12 * 60.0 / 2e-6)


@pytest.mark.parametrize(
    ("reference", "scan", "known"),
    [
        (scan_taken(True), scan_taken(False), prior((1e-10, 0.0))),
        (scan_taken(None), scan_taken(None), prior((1e-10, 0.0))),
        (scan_taken(True), scan_taken(True, math.radians(90.0)), prior((1e-10, 0.0))),
        (scan_taken(True), scan_taken(True, duration_s=120.0), prior((1e-10, 0.0))),
        (scan_taken(True), scan_taken(True), prior((1e-10, 0.0), None)),
    ],
    ids=["up and down", "directions not known", "turned", "faster", "velocities not known"],
)
def test_a_difference_of_velocities_does_not_apply_to_scans_taken_differently(
    reference: DriftScan, scan: DriftScan, known: Prior
) -> None:
    mean, sd = shear_by_drift(known, reference, scan)
    assert (mean == 0.0).all()
    assert sd is None


def fit_of_blocks(moved_px: NDArray[np.float64], information: NDArray[np.float64]) -> tuple[Fit, float]:
    """Return a fit of blocks of rows with these displacements along x, and its shift, the mean by information."""
    shift = float(np.average(moved_px, weights=information))
    curvature = information[:, None, None] * np.eye(COUNT)
    theta = np.zeros(COUNT)
    theta[0] = shift
    slope = information[:, None] * np.where(np.arange(COUNT) == 0, shift - moved_px[:, None], 0.0)
    return Fit(theta, curvature, curvature, slope), shift


def test_the_displacement_is_the_mean_over_rows_and_not_over_features() -> None:
    moved_px, information = np.array([0.0, 0.1, 0.3, 0.6]), np.array([1e6, 2e6, 5e6, 1e4])
    fit, shift = fit_of_blocks(moved_px, information)
    assert abs(shift - 0.25) > 0.03
    assert mean_over_rows(fit) == pytest.approx([0.25 - shift, 0.0], abs=2e-3)


def test_rows_without_features_do_not_move_the_mean() -> None:
    fit, _ = fit_of_blocks(np.array([0.0, 0.02, -0.02, 30.0]), np.array([1e6, 1e6, 1e6, 1e-3]))
    assert np.abs(mean_over_rows(fit)).max() < 1e-3


def test_rows_that_move_alike_leave_the_shift_as_it_is() -> None:
    random = np.random.default_rng(1)
    information = 10.0 ** random.uniform(2.0, 4.0, 16)
    fit, _ = fit_of_blocks(random.standard_normal(16) / np.sqrt(information), information)
    assert np.abs(mean_over_rows(fit)).max() < 0.5 / np.sqrt(information.sum())


def told(shift: float, shear: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return information from images that determine a shift along x plus ten times a shear to 0.1 px.

    Everything else is determined well.
    """
    information = 1e8 * np.eye(COUNT)
    information[np.ix_([0, 3], [0, 3])] = np.outer((10.0, 100.0), (10.0, 100.0))
    theta = np.zeros(COUNT)
    theta[[0, 3]] = shift, shear
    return information, information @ theta, 1e-4 * np.eye(COUNT)


def test_plausible_shear_decides_where_shift_and_shear_are_alike() -> None:
    still, total = averaged(*told(0.5, 0.05), Shear(sds=(1e-5,)))
    assert still[0] == pytest.approx(1.0, abs=0.01), "all of it is a shift"
    assert math.sqrt(total[0, 0]) == pytest.approx(0.1, rel=0.05)
    sheared, _ = averaged(*told(0.5, 0.05), Shear(mean=np.array([[0.0, 0.08], [0.0, 0.0]]), sds=(1e-5,)))
    assert sheared[[0, 3]] == pytest.approx([0.2, 0.08], abs=0.01), "as was expected"
    _, unsure = averaged(*told(0.5, 0.05), Shear(sds=(0.05,)))
    assert math.sqrt(unsure[0, 0]) > 0.3, "it may be either"


def test_visible_creep_is_fitted_and_invisible_creep_is_zero() -> None:
    information = np.diag([1.0, 1.0, *[1e8] * 4, 1e4, *[1.0] * (COUNT - 7)])
    theta = np.zeros(COUNT)
    theta[6] = 0.5
    seen, total = averaged(information, information @ theta, 1e-4 * np.eye(COUNT), Shear())
    assert seen[6] == pytest.approx(0.5, abs=0.01)
    assert abs(seen[8:10]).max() < 1e-3, "at the other end there is none"
    none, without = averaged(information, np.zeros(COUNT), 1e-4 * np.eye(COUNT), Shear())
    assert none == pytest.approx(np.zeros(COUNT), abs=1e-12)
    assert without[6, 6] < total[6, 6] / 4


def test_a_stretch_of_a_row_that_stands_out_is_mended_and_features_stay() -> None:
    y, x = np.mgrid[:64, :64].astype(float)
    random = np.random.default_rng(8)
    surface = (
        np.exp(-((x - 20) ** 2 + (y - 40) ** 2) / 8)
        + np.tanh((x + y - 60) / 6)
        + 0.02 * random.standard_normal(x.shape)
    )
    scarred = surface.copy()
    scarred[10, 12:40] += 0.7
    scarred[30, 5:30] -= 0.5
    assert without_scars(surface) == pytest.approx(surface)
    assert abs(without_scars(scarred) - surface).max() < 0.15


def test_the_noise_left_in_a_shrunk_image_is_known_from_independent_noise() -> None:
    random = np.random.default_rng(3)
    y, x = np.mgrid[:128, :128].astype(float)
    image = np.exp(-(((x - 40) / 3) ** 2)) + np.sin(y / 9) * np.exp(-(((y - 80) / 20) ** 2))
    own, other = (0.2 * random.standard_normal(image.shape) for _ in range(2))
    shrunk, through = denoised(image + own, other)
    left, told = np.vdot(shrunk, own), np.vdot(through, other)
    assert 0.02 < left / np.vdot(own, own) < 0.5, "some of it is left, and most of it isn't"
    assert told == pytest.approx(left, rel=0.15)


def test_a_derivative_is_exact_for_short_waves_and_at_borders() -> None:
    x = np.arange(40.0)
    wave = np.sin(2 * np.pi * x / 5)
    found = derivative(np.stack([wave] * 12, axis=1), 0)[8:-8, 3]
    assert found == pytest.approx(2 * np.pi / 5 * np.cos(2 * np.pi * x / 5)[8:-8], abs=0.015)
    assert derivative(np.stack([3.0 * x] * 12), 1) == pytest.approx(3.0)


def test_noise_in_the_gradient_is_not_counted_as_information() -> None:
    spread, seen = np.diag(np.geomspace(1e4, 1e6, COUNT)), np.full(COUNT, 1.0)
    seen[2] = 0.5  # of the slope's variance in this direction, half is noise
    believed = Believed(np.zeros(COUNT), np.eye(COUNT))
    curvature, theta = spread * seen, np.linspace(0.1, 1.0, COUNT)
    fit = Fit(theta, curvature[None], spread[None], np.zeros((1, COUNT)))
    information, pull = fit.information(believed)
    assert np.diag(information) == pytest.approx(seen**2 * np.diag(spread), rel=1e-4)
    by_images_alone = theta + np.linalg.solve(curvature, theta)  # the prior has pulled theta towards zero
    assert pull == pytest.approx(information @ by_images_alone, rel=1e-6)


@pytest.mark.filterwarnings("error")
def test_image_with_a_flat_half_has_finite_shrunk_coefficients() -> None:
    random = np.random.default_rng(0)
    image, noise = 10.0 * random.standard_normal((96, 90)), 10.0 * random.standard_normal((96, 90))
    image[:48] = 0.0
    assert all(np.isfinite(each).all() for each in denoised(image, noise))
