"""Drift during a scan's own acquisition is removed, judged by the simulator's truth."""

from __future__ import annotations

import math

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.model import Region, Scan
from afspm.model.arrays import Array
from afspm.simulation import World

SIZE_M = 400e-9
PIXELS = 128
PIXEL_M = SIZE_M / (PIXELS - 1)
LINE_S = 2.0
DURATION_S = (PIXELS - 1) * LINE_S
SURFACES = {
    "rough": {"kind": "rough"},
    "particles": {"kind": "particles"},
    "steps": {"kind": "steps"},
}
QUIET = {
    "noise": {
        "white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0, "debris_jumps_per_s": 0.0
    },
    "scanner": {"oversampling": 4},
}  # fmt: skip


def scanned(surface: str, velocity_px: tuple[float, float], region: Region, direction: str = "up") -> Scan:
    """Return a scan in a world that drifts by some pixels per frame."""
    velocity = [v * PIXEL_M / DURATION_S for v in velocity_px]
    settings = {"surface": SURFACES[surface], **QUIET, "drift": {"velocity_m_per_s": [*velocity, 0.0]}}
    world = World.from_settings(settings, seed=3, start_s=0.0)
    unit, values = world.scan(region, (PIXELS, PIXELS), LINE_S, 0.0, direction=direction).channels()["Height"]
    return Scan(region, "Height", unit, values)


def distortion_px(scan: Array, truth: Array) -> tuple[Array, Array]:
    """Displacement (2,) and, for a whole frame, its change (2, 2) over x and y, by least squares of small ones."""
    inner = (slice(12, -12), slice(12, -12))
    gy, gx = np.gradient((scan + truth) / 2)
    y, x = np.mgrid[-0.5 : 0.5 : scan.shape[0] * 1j, -0.5 : 0.5 : scan.shape[1] * 1j]
    columns = [g * p for g in (gx, gy) for p in (1.0, x, y)]
    matrix = np.stack([c[inner].ravel() for c in [*columns, np.ones_like(x)]], axis=1)
    found = np.linalg.lstsq(matrix, (truth - scan)[inner].ravel(), rcond=None)[0][:6].reshape(2, 3)
    return found[:, 0], found[:, 1:]


@pytest.mark.parametrize("direction", ["up", "down"])
@pytest.mark.parametrize("surface", SURFACES)
def test_distortion_is_removed(surface: str, direction: str) -> None:
    velocity_px, upwards = (1.6, -1.2), direction == "up"
    region = Region((0.0, 0.0), (SIZE_M, SIZE_M))
    scan = scanned(surface, velocity_px, region, direction)
    # Traces are taken at a quarter of their line's time.
    middle_s = DURATION_S / 2 + LINE_S / 4
    drift_m = np.array(velocity_px) * PIXEL_M * middle_s / DURATION_S
    truth = scanned(surface, (0.0, 0.0), region.moved_to((-drift_m[0], -drift_m[1]))).values
    velocity = (velocity_px[0] * PIXEL_M / DURATION_S, velocity_px[1] * PIXEL_M / DURATION_S)
    shift, change = distortion_px(scan.undistorted(velocity, DURATION_S, upwards=upwards).values, truth)
    _, before = distortion_px(scan.values, truth)
    assert np.abs(before[:, 1]).max() > 0.5
    assert np.abs(change).max() < 0.05
    assert np.abs(shift).max() < 0.05


def ramp(region: Region, shape: tuple[int, int], slope: tuple[float, float]) -> Array:
    x, y = region.pixels_m(shape)
    return slope[0] * x + slope[1] * y


@pytest.mark.parametrize("upwards", [True, False])
@pytest.mark.parametrize("angle_rad", [0.0, 0.7, -2.0])
def test_tilted_plane_is_restored(angle_rad: float, *, upwards: bool) -> None:
    """What a spline interpolates exactly, in a turned region with pixels that are not square."""
    region, shape = Region((3e-7, -2e-7), (1e-6, 0.5e-6), angle_rad), (40, 50)
    velocity, duration_s, slope = np.array([0.08e-9, -0.05e-9]), 400.0, (0.3, -0.2)
    x, y = region.pixels_m(shape)
    delay_s = (np.arange(shape[0]) / (shape[0] - 1) - 0.5)[:, None] * duration_s * (1.0 if upwards else -1.0)
    values = slope[0] * (x - velocity[0] * delay_s) + slope[1] * (y - velocity[1] * delay_s)
    scan = Scan(region, "Height", "m", values)
    found = scan.undistorted((velocity[0], velocity[1]), duration_s, upwards=upwards).values
    truth = ramp(region, shape, slope)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(found - truth)[inner].max() < 1e-3 * np.abs(values - truth)[inner].max()


def test_values_outside_of_the_scan_are_nan() -> None:
    """A sample that moved up with the rows was stretched: it fills more rows than it should."""
    region = Region((0.0, 0.0), (1e-6, 1e-6))
    scan = Scan(region, "Height", "m", np.ones((11, 11)))
    stretched = scan.undistorted((0.0, 0.5e-9), 400.0).values  # a fifth of the height
    squeezed = scan.undistorted((0.0, -0.5e-9), 400.0).values
    assert np.isnan(stretched[:1]).all()
    assert np.isfinite(stretched[1:-1]).all()
    assert np.isfinite(squeezed).all()


@pytest.mark.parametrize("pixel", [(5, 5), (0, 0)])
def test_missing_values_stay_missing(pixel: tuple[int, int]) -> None:
    values = np.random.default_rng(1).standard_normal((11, 11))
    values[pixel] = np.nan
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", values)
    still = scan.undistorted((0.0, 0.0), 100.0).values
    assert np.array_equal(np.isnan(still), np.isnan(values))
    moved = scan.undistorted((0.5e-9, 0.0), 100.0).values
    assert np.isnan(moved[pixel[0], max(pixel[1] - 1, 0) : pixel[1] + 2]).any()
    assert np.isfinite(moved).sum() > 90


def test_a_scan_without_any_value_stays_so() -> None:
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.full((5, 5), np.nan))
    assert np.isnan(scan.undistorted((1e-10, 0.0), 100.0).values).all()


@pytest.mark.parametrize(
    ("velocity", "duration_s"),
    [((math.nan, 0.0), 1.0), ((0.0, 0.0), math.inf), ((0.0, 0.0), -1.0), ((0.0, 1e-8), 100.0)],
)
def test_invalid_velocity_or_duration_is_refused(velocity: tuple[float, float], duration_s: float) -> None:
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.ones((5, 5)))
    with pytest.raises(InvalidValue):
        scan.undistorted(velocity, duration_s)


def test_unknown_direction_is_refused() -> None:
    """Files of the record, and those of some other programs, do not contain it."""
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.ones((5, 5)))
    with pytest.raises(InvalidValue, match="direction of the slow axis is unknown"):
        scan.undistorted((1e-10, 0.0), 100.0, upwards=None)
