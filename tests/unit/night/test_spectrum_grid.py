"""Spectra of a grid as one array over (y, x, repeat, direction, z)."""

from __future__ import annotations

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.model import Spectrum
from afspm.night.spectrum_stack import stacked
from afspm.record.spectrum_grid import grid

BIAS = np.linspace(-1.0, 1.0, 11)
XY = tuple[float, float]


def iv(position_m: XY | None, current: float = 1.0, bias: np.ndarray = BIAS, kind: str = "IV") -> Spectrum:
    values = np.stack([bias, current * bias, 2 * current * bias], axis=1)
    return Spectrum(position_m, kind, ("Bias", "Current", "Current Retrace"), ("V", "A", "A"), values, 5)


def places(columns: int, rows: int, angle_rad: float = 0.0) -> list[XY]:
    x, y = np.meshgrid(np.arange(columns) * 2e-9, np.arange(rows) * 3e-9)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return [(float(cos * a - sin * b), float(sin * a + cos * b)) for a, b in zip(x.ravel(), y.ravel(), strict=True)]


def test_curves_lie_where_they_were_measured() -> None:
    spectra = [iv(place, current) for current, place in enumerate(places(3, 2), 1)]
    arrays = stacked(spectra[::-1]).to_xarray()
    assert arrays.Current.dims == ("y", "x", "repeat", "direction", "z")
    assert arrays.Current.shape == (2, 3, 1, 2, 11)
    assert arrays.x.values == pytest.approx([0.0, 2e-9, 4e-9])
    assert arrays.y.values == pytest.approx([0.0, 3e-9])
    assert arrays.x.attrs["units"] == "m"
    there, back = arrays.Current.isel(y=1, x=0, repeat=0)
    assert there.values == pytest.approx(4 * BIAS)
    assert back.values == pytest.approx(8 * BIAS)
    assert list(arrays.direction.values) == ["forward", "backward"]
    assert arrays.Current.attrs["units"] == "A"
    assert arrays.z.attrs == {"long_name": "Bias", "units": "V", "role": "bias"}
    assert arrays.Current.attrs["role"] == "current"
    assert arrays.attrs["kind"] == "IV"


def test_missing_curves_are_nan_and_repeats_are_counted() -> None:
    measured = [place for number, place in enumerate(places(3, 3)) if number != 4]
    arrays = stacked([iv(place) for place in [*measured, measured[0]]]).to_xarray()
    assert dict(arrays.sizes) == {"y": 3, "x": 3, "repeat": 2, "direction": 2, "z": 11}
    assert np.isnan(arrays.Current.isel(y=1, x=1)).all()
    assert np.isfinite(arrays.Current.isel(y=0, x=0)).all()
    assert np.isnat(arrays.time.values).sum() == 18 - 9


@pytest.mark.parametrize("angle_rad", [0.3, -0.4, 0.7])
def test_a_grid_may_be_turned_and_a_little_inexact(angle_rad: float) -> None:
    exact = np.array(places(7, 5, angle_rad)) + 1e-7
    found = grid([tuple(place) for place in exact + np.random.default_rng(1).normal(0, 2e-11, exact.shape)])
    assert found.angle_rad == pytest.approx(angle_rad, abs=0.01)
    assert found.cells == tuple((row, column) for row in range(5) for column in range(7))
    assert np.diff(found.x_m) == pytest.approx([2e-9] * 6, rel=0.02)


def test_a_sweep_that_turns_round_has_two_directions() -> None:
    z = np.linspace(0.0, 1e-7, 8)
    sweep = np.concatenate([z, z[::-1]])
    spectrum = Spectrum((0.0, 0.0), "force", ("Z", "Force"), ("m", "N"), np.stack([sweep, np.arange(16.0)], axis=1))
    arrays = stacked([spectrum]).to_xarray()
    assert list(arrays.direction.values) == ["forward", "backward"]
    assert arrays.Force.values.ravel().tolist() == [*range(8), *range(15, 7, -1)]


def test_positions_without_a_grid_are_refused_with_the_reason() -> None:
    random = np.random.default_rng(0)
    with pytest.raises(InvalidValue, match="no grid"):
        stacked([iv((float(x), float(y))) for x, y in random.uniform(0, 1e-7, (9, 2))]).to_xarray()
    with pytest.raises(InvalidValue, match="different kinds"):
        stacked([iv((0.0, 0.0)), iv((0.0, 0.0), kind="force")]).to_xarray()
    with pytest.raises(InvalidValue, match="swept differently: 11 points of Bias from -2 to 2 V instead"):
        stacked([iv((0.0, 0.0)), iv((0.0, 0.0), bias=2 * BIAS)]).to_xarray()
    with pytest.raises(InvalidValue, match="position of spectrum 1"):
        stacked([iv(None)]).to_xarray()


def test_force_curves_that_begin_at_the_surface_come_to_common_values_if_wanted() -> None:
    spectra = []
    for number, place in enumerate(places(2, 1)):
        z = np.linspace(-1e-8 * number, 1e-7, 30)[::-1]
        values = np.stack([z, 3.0 * z, 3.0 * z], axis=1)
        spectra.append(Spectrum(place, "force", ("Z", "Force", "Force [bwd]"), ("m", "N", "N"), values))
    with pytest.raises(InvalidValue, match=r"swept differently.*interpolate=True"):
        stacked(spectra).to_xarray()
    arrays = stacked(spectra, interpolate=True).to_xarray()
    assert arrays.z.values[[0, -1]] == pytest.approx([0.0, 1e-7])
    assert arrays.Force.isel(x=1, direction=1).values.ravel() == pytest.approx(3.0 * arrays.z.values)
    with pytest.raises(InvalidValue, match="no values in common"):
        stacked([iv((0.0, 0.0)), iv((0.0, 0.0), bias=BIAS + 9.0)], interpolate=True).to_xarray()
