"""Scans taken while the sample moves are aligned in the stack."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import Frame, Region
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track.offline import corrected

PIXEL_M = 1e-6 / 63


def surface(x_m: Array, y_m: Array) -> Array:
    """A smooth landscape without a period in the frame."""
    waves = ((2.1e7, 0.4e7, 0.0), (-0.7e7, 1.8e7, 1.0), (1.1e7, 1.3e7, 2.0))
    return np.asarray(sum(np.sin(x_m * kx + y_m * ky + phase) for kx, ky, phase in waves))


def scan(
    drift_m: tuple[float, float],
    rate_m_s: tuple[float, float] = (0.0, 0.0),
    *,
    center_m: tuple[float, float] = (0.0, 0.0),
    angle_rad: float = 0.0,
    upwards: bool | None = True,
) -> DriftScan:
    """Return a scan of the landscape, with the sample displaced by `drift_m` in the middle of 100 s."""
    region = Region(center_m, (1e-6, 0.8e-6), angle_rad)
    shape = (51, 64)
    x, y = region.pixels_m(shape)
    since = np.linspace(-50.0, 50.0, shape[0])[:: 1 if upwards is not False else -1, None]
    values = surface(x - drift_m[0] - rate_m_s[0] * since, y - drift_m[1] - rate_m_s[1] * since)
    return DriftScan(values, region, 0.0, 100.0, upwards, "a scan")


@pytest.mark.parametrize("angle_rad", [0.0, math.radians(35)])
@pytest.mark.parametrize("upwards", [True, False])
def test_drift_distorted_scans_show_the_same_place_in_the_stack(angle_rad: float, upwards: bool) -> None:
    drifts, rates = [(0.0, 0.0), (80e-9, -50e-9), (-30e-9, 120e-9)], [(0.0, 0.0), (0.3e-9, 0.4e-9), (-0.5e-9, 0.2e-9)]
    scans = [
        scan(drift, rate, angle_rad=angle_rad, upwards=upwards, center_m=(50e-9 * k, 0.0))
        for k, (drift, rate) in enumerate(zip(drifts, rates, strict=True))
    ]
    stack = corrected(scans, np.array(drifts), np.array(rates))
    assert stack.region.frame is Frame.SAMPLE
    inner = (slice(4, -4), slice(4, -4))  # at the border the spline knows less
    truth = surface(*stack.region.pixels_m(stack.values.shape[1:]))[inner]
    for values in stack.values:
        assert np.abs(values[inner] - truth).max() < 2e-3
    still = corrected(scans, np.array(drifts))
    assert np.abs(still.values[1][inner] - truth).max() > 0.1, "without the rate the rows lie elsewhere"


def test_the_stack_covers_the_common_area_with_the_pixels_of_the_first() -> None:
    stack = corrected([scan((0.0, 0.0)), scan((200e-9, 0.0))], np.array([(0.0, 0.0), (200e-9, 0.0)]))
    (left, _), (width, height) = stack.region.top_left_m, stack.region.size_m
    assert width == pytest.approx(0.8e-6, abs=PIXEL_M)
    assert left == pytest.approx(-0.5e-6, abs=PIXEL_M)
    assert height == pytest.approx(0.8e-6)
    assert width / (stack.values.shape[2] - 1) == pytest.approx(PIXEL_M)


def test_unmeasured_pixels_stay_empty_in_the_stack() -> None:
    holed = scan((0.0, 0.0))
    holed.values[:10] = np.nan
    stack = corrected([holed, scan((0.0, 0.0))], np.zeros((2, 2)))
    assert np.isnan(stack.values[0, :9]).all()
    assert np.isfinite(stack.values[0, 11:]).all()
    assert np.isfinite(stack.values[1]).all()


def test_scans_without_a_common_area_and_of_different_angles_are_refused() -> None:
    with pytest.raises(InvalidValue, match="no common area"):
        corrected([scan((0.0, 0.0)), scan((2e-6, 0.0))], np.array([(0.0, 0.0), (2e-6, 0.0)]))
    with pytest.raises(InvalidValue, match="different angles"):
        corrected([scan((0.0, 0.0)), scan((0.0, 0.0), angle_rad=0.1)], np.zeros((2, 2)))


def test_a_written_stack_opens_with_its_coordinates(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    stack = corrected([scan((0.0, 0.0)), scan((0.0, 0.0))], np.zeros((2, 2)))
    stack.write(tmp_path / "stack.nc", channel="Height", unit="m")
    with xarray.open_dataset(tmp_path / "stack.nc", engine="scipy", decode_times=False) as opened:
        np.testing.assert_array_equal(opened["Height"].values, stack.values)
        assert opened["x"].values[[0, -1]] == pytest.approx([-0.5e-6, 0.5e-6])
        assert opened["Height"].attrs["units"] == "m"
        assert opened.attrs["frame"] == "sample"
