"""Levelling: a tilted or curved substrate is flat afterwards, particles or not."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.model import Region, Scan
from afspm.model.levelling import FITS
from afspm.model.line_levelling import Levelling, flattened
from afspm.model.line_levelling import levelled as line_levelled

SHAPE = (48, 64)
Y, X = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
PARTICLES = ((X - 0.3) ** 2 + (Y + 0.2) ** 2 < 0.15) | ((X + 0.6) ** 2 + (Y - 0.5) ** 2 < 0.05)


def scan(values: np.ndarray) -> Scan:
    return Scan(Region((0.0, 0.0), (1e-6, 0.75e-6)), "Height", "m", values)


def substrate(order: int) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0.0, 0.05, SHAPE)
    curved = 8.0 * X * X - 5.0 * X * Y if order > 1 else 0.0
    return 1e-9 * (40.0 + 20.0 * X - 12.0 * Y + curved + noise)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("fit", sorted(FITS))
def test_a_substrate_is_flat_afterwards(fit: str, order: int) -> None:
    flat = scan(substrate(order)).levelled(order, fit).values
    assert np.abs(flat).max() < 1e-9
    assert abs(np.median(flat)) < 0.1e-9


@pytest.mark.parametrize("fit", sorted(set(FITS) - {"least-squares"}))
def test_particles_do_not_lead_a_robust_fit_astray(fit: str) -> None:
    values = substrate(1) + 30e-9 * PARTICLES
    flat = scan(values).levelled(1, fit, 0.4).values
    assert flat[~PARTICLES].std() < 0.35e-9
    assert flat[PARTICLES].mean() - flat[~PARTICLES].mean() == pytest.approx(30e-9, rel=0.03)
    plain = scan(values).levelled(1).values
    assert plain[~PARTICLES].std() > 3.0 * flat[~PARTICLES].std()


def test_missing_values_stay_missing_and_do_not_affect_the_fit() -> None:
    values = substrate(1)
    values[30:] = np.nan
    flat = scan(values).levelled().values
    assert np.isnan(flat[30:]).all()
    assert np.abs(flat[:30]).max() < 1e-9


def test_a_scan_of_one_height_is_level() -> None:
    assert np.abs(scan(np.full(SHAPE, 7e-9)).levelled(1, "huber").values).max() < 1e-20


def test_scan_that_can_not_be_levelled_is_refused() -> None:
    with pytest.raises(InvalidValue, match="no fit 'median'"):
        scan(substrate(1)).levelled(1, "median")
    with pytest.raises(InvalidValue, match="order 7"):
        scan(substrate(1)).levelled(7)
    with pytest.raises(InvalidValue, match="too little"):
        scan(np.full(SHAPE, np.nan)).levelled()


@pytest.mark.parametrize("rows", ["median", "difference", "line"])
def test_rows_are_levelled_one_by_one(rows: str) -> None:
    steps = np.random.default_rng(0).normal(size=(16, 1))
    values = np.broadcast_to(steps, (16, 32)).copy()
    values[3, 4] = np.nan
    values[7] = np.nan
    flat = scan(values).levelled(rows=rows).values
    assert np.nanmax(np.abs(flat)) < 1e-4 < np.ptp(steps)
    assert np.isnan(flat[7]).all()
    with pytest.raises(InvalidValue, match="one of difference, line, median"):
        scan(values).levelled(rows="mean")


@pytest.mark.parametrize("rows", ["median", "difference", "line"])
@pytest.mark.parametrize("part", [0.05, 0.3, 0.6])
def test_scattered_missing_pixels_leave_no_tilt(rows: str, part: float) -> None:
    tilt = 0.3e-9 * np.arange(SHAPE[1]) - 0.1e-9 * np.arange(SHAPE[0])[:, None]
    missing = np.random.default_rng(1).random(SHAPE) < part
    missing[5] = True
    flat = scan(np.where(missing, np.nan, tilt)).levelled(rows=rows).values
    np.testing.assert_array_equal(np.isnan(flat), missing)
    np.testing.assert_allclose(flat[~missing], 0.0, atol=1e-17)


def test_row_steps_are_levelled_where_pixels_are_missing() -> None:
    generator = np.random.default_rng(2)
    steps = generator.normal(0.0, 5e-9, SHAPE[0])[:, None]
    missing = generator.random(SHAPE) < 0.3
    flat = scan(np.where(missing, np.nan, substrate(1) + steps)).levelled(rows="median").values
    assert np.nanstd(flat) < 0.07e-9


def test_missing_rows_change_no_other_row() -> None:
    values = substrate(2)
    rows = values - np.median(values, axis=1, keepdims=True)
    values[10:20] = np.nan
    np.testing.assert_array_equal(line_levelled(values, Levelling.MEDIANS)[20:], rows[20:])


def _with_particle(middle: float, noise: float) -> np.ndarray:
    y, x = np.mgrid[-1.0:1.0:96j, -1.0:1.0:96j]
    particle: np.ndarray = 100.0 / (1.0 + np.exp(40.0 * (np.hypot(0.6 * (x - middle), y) - 0.3)))
    particle += np.random.default_rng(4).normal(0.0, noise, x.shape)
    return particle


@pytest.mark.parametrize("middle", [0.2, 0.7], ids=["inside", "over the border"])
def test_particle_throws_no_shadow_where_the_controller_has_fitted_a_line_to_each_row(middle: float) -> None:
    true = _with_particle(middle, 0.5)
    delivered = line_levelled(true, Levelling.LINES)
    beside = true < 5.0
    assert delivered[beside].min() < -30.0, "the line of a row with the particle lies above the surface beside it"
    found = flattened(delivered)
    off = found - true - np.median((found - true)[beside])
    assert np.percentile(np.abs(off[beside]), 99.0) < 8.0
    assert np.median(off[true > 95.0]) == pytest.approx(0.0, abs=6.0)


def test_rows_without_a_subtracted_line_are_aligned_by_their_heights_alone() -> None:
    values = _with_particle(0.2, 0.5) + np.linspace(0.0, 20.0, 96)
    aligned = line_levelled(values, Levelling.DIFFERENCES)
    found = flattened(values)
    surface = aligned - found  # a plane: the second differences along both sides vanish
    assert np.abs(np.diff(surface, 2, axis=0)).max() < 1e-9
    assert np.abs(np.diff(surface, 2, axis=1)).max() < 1e-9


def test_noise_alone_with_subtracted_lines_stays_flat() -> None:
    delivered = line_levelled(np.random.default_rng(5).normal(0.0, 1.0, (96, 96)), Levelling.LINES)
    assert flattened(delivered).std() == pytest.approx(delivered.std(), rel=0.05)
