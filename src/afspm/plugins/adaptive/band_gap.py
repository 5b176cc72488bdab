"""The gap of a spectrum of tunnelling: the distance of the edges of the density of states, from I(V) or dI/dV.

dI/dV is the density of states, rounded by the temperature and by the modulation of the lock-in amplifier, so that no
threshold of it is the gap: at 4 K the coherence peaks of a superconductor stand outside its gap by up to a third of it,
and a band that begins linearly reaches any threshold later than one that begins as a square root. Four densities are
fitted, each with its rounding:

| density | beyond an edge |
| --- | --- |
| bands in three dimensions, parabolic | the square root of the energy |
| bands with a linear onset | the energy |
| bands in two dimensions | constant |
| superconductor | Dynes, Narayanamurti and Garno (1978): the gap is 2 Delta |

The one that leaves the least is taken. Others that the noise can't exclude count in the error.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import j1

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import Spectrum, names

_BIAS: Final = "bias"
_CONDUCTANCE: Final = "conductance"
_CURRENT: Final = "current"
_BACK: Final = ", retrace"
_LEAST_POINTS: Final = 24
_CLIPPED: Final = 0.99
"""Share of the largest current above which the preamplifier may be saturated."""
_ONSETS: Final = (0.5, 1.0, 0.0)
_GRID: Final = 1024
_MARGIN: Final = 0.3
"""Of the range of the bias, on both sides: the energies from which electrons come by temperature and modulation."""
_WIDEST: Final = 10.0
"""The widest rounding, as a part of the range."""
_TRANSMISSION: Final = (-1.0, 2.5)
"""Bounds of the logarithmic slope of the transmission in 1/V: 0.9 for a barrier of 4 eV and 0.7 nm."""
_STARTS: Final = (0.15, 0.5)
"""Shares of the conductance where the search for the edges begins."""
_OFF_ZERO: Final = 0.1
"""Farthest middle of a superconducting gap from 0 V, as a share of the range: offsets of the bias."""
_CALLS: Final = 40
"""Most evaluations of a fit: beyond, it is one that the curve does not determine."""
_SHARES: Final = 4
"""Parameters of a fit that are linear: two bands, a leak and an offset."""
_MOST_ALIKE: Final = 0.98
_STAYS: Final = 0.999
"""Share of the largest current above which `_LEAST_CLIPPED` points prove a saturation: the current rises no more."""
_LEAST_CLIPPED: Final = 4
_MOST_ERROR: Final = 0.25
"""Largest standard error of the gap, as a share of it."""
_EXCLUDED: Final = 25.0
"""By how much the sum of squares of a density is larger, in variances, that the noise excludes."""
_LEAST_BETTER: Final = 1.5
"""Least scatter of the curve around a cubic, in that around the best density."""


@dataclass(frozen=True)
class BandGap:
    """The gap of a density of states.

    Attributes:
        value_ev: distance of the edges; of a superconductor 2 Delta.
        error_ev: standard error, from the noise, and from other densities that explain the curve.
        density: "onset 0.5", "onset 1", "onset 0" (the exponent of the bands) or "superconductor".
    """

    value_ev: float
    error_ev: float
    density: str


def band_gap(spectrum: Spectrum) -> BandGap:
    """Fit the gap.

    The modulation is taken from the settings in force, and fitted where it is unknown.

    Raises:
        NoSuchItem: the spectrum has no bias, or neither conductance nor current. InvalidValue: it shows no gap, or the
            gap is known to less than a quarter.
    """
    curve = _Curve.of(spectrum)
    densities = [*(_bands(onset, curve) for onset in _ONSETS), _superconductor(curve)]
    fits = [curve.fitted(density) for density in densities]
    best = min(fits, key=lambda fit: fit.squares)
    if curve.squares_of_cubic() < _LEAST_BETTER**2 * best.squares:
        raise InvalidValue("the curve has no band edge", hint="sweep the bias farther, with more points")
    limit = best.squares * (1.0 + _EXCLUDED * best.alike / len(curve.bias_v))
    others = [abs(fit.gap_ev - best.gap_ev) for fit in fits if fit.squares < limit]
    error = math.hypot(best.error_ev, max(others))
    if not error <= _MOST_ERROR * best.gap_ev:
        found = f"{best.gap_ev:.3g} eV ± {error:.1g} eV"
        raise InvalidValue(f"the gap of {found} is too uncertain", hint="average more sweeps, or sweep farther")
    return BandGap(best.gap_ev, error, best.density)


@dataclass(frozen=True)
class _Fit:
    # squares: per degree of freedom; alike: how much more noise of low frequency there is than white noise
    gap_ev: float
    error_ev: float
    density: str
    squares: float
    alike: float


@dataclass(frozen=True)
class _Density:
    """A model of the density of states, in units of the range of the bias.

    Attributes:
        starts, lowest, highest: the parameters of its shape.
        columns: functions of the energy for some parameters, shape (functions, energies); the curve is a sum of them.
        gap: the gap as a linear function of the parameters.
    """

    name: str
    starts: list[tuple[float, ...]]
    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    columns: Callable[[Array, Array], Array]
    gap: tuple[float, ...]


@dataclass(frozen=True)
class _Curve:
    """A curve in units of the range of its bias, and of its largest value."""

    bias_v: Array
    values: Array
    weights: Array
    is_current: bool
    modulation: float | None
    extent_v: float
    middle_v: float

    @classmethod
    def of(cls, spectrum: Spectrum) -> _Curve:
        if (unit := spectrum.si_unit_of(_BIAS)) not in ("V", ""):
            raise InvalidValue(f"the bias is in {unit}")
        is_current = not spectrum.has(_CONDUCTANCE)
        bias, values = _both_ways(spectrum, _CURRENT if is_current else _CONDUCTANCE)
        stated = [one.constant for one in spectrum.in_force if one.name == names.LOCK_IN_AMPLITUDE and one.unit == "V"]
        modulation_v = 0.0 if is_current else next(iter(stated), None)
        good = np.isfinite(bias) & np.isfinite(values)
        if spectrum.has(_CURRENT):
            current = np.abs(_both_ways(spectrum, _CURRENT)[1])
            good &= ~_saturated(bias, current, modulation_v or 0.0)
        bias, values = bias[good], values[good]
        order = np.argsort(bias)
        bias, values = bias[order], values[order]
        if len(bias) < _LEAST_POINTS:
            what = f"{len(bias)} points of the curve are not saturated, and a gap needs {_LEAST_POINTS}"
            raise InvalidValue(what, hint="measure more points, with less gain of the preamplifier")
        if not np.ptp(bias) or not np.ptp(values):
            raise InvalidValue("the curve has no band edge", hint="sweep the bias farther")
        extent, middle = float(np.ptp(bias)), float(bias[0] + bias[-1]) / 2.0
        values = values / np.abs(values).max()
        modulation = None if modulation_v is None else modulation_v / extent
        weights = 1.0 / np.sqrt(_variance(values))
        return cls((bias - middle) / extent, values, weights, is_current, modulation, extent, middle)

    def squares_of_cubic(self) -> float:
        degree = 4 if self.is_current else 3
        fit = np.polynomial.Polynomial.fit(self.bias_v, self.values, degree, w=self.weights)
        left = self.weights * (self.values - fit(self.bias_v))
        return float(left @ left) / (len(left) - degree - 1)

    def ends_of_gap(self, share: float) -> tuple[float, float]:
        """Return where the conductance exceeds a share of its largest value, on both sides of its least."""
        conductance = np.gradient(self.values, self.bias_v) if self.is_current else self.values
        width = 2 * (len(conductance) // 50) + 1
        smoothed = np.convolve(np.pad(conductance, width // 2, mode="edge"), np.full(width, 1.0 / width), mode="valid")
        lowest = int(np.argmin(smoothed))
        above = smoothed > smoothed[lowest] + share * float(np.ptp(smoothed))
        left, right = np.flatnonzero(above[:lowest]), lowest + np.flatnonzero(above[lowest:])
        low = self.bias_v[left[-1]] if len(left) else self.bias_v[0]
        return float(low), float(self.bias_v[right[0]] if len(right) else self.bias_v[-1])

    def fitted(self, density: _Density) -> _Fit:
        """Fit a density, its rounding by the temperature, and that by the modulation where it is not known."""
        step = (1.0 + 2.0 * _MARGIN) / _GRID
        energy: Array = np.arange(_GRID, dtype=np.float64) * step + (step / 2.0 - 0.5 - _MARGIN)
        omega = 2.0 * math.pi * np.fft.rfftfreq(_GRID, step)
        shapes = len(density.lowest)

        def design(parameters: Array) -> Array:
            modulation = self.modulation if self.modulation is not None else math.exp(parameters[shapes + 1])
            x = np.clip(math.pi * math.exp(parameters[shapes]) * omega, 1e-9, 300.0)
            y = np.maximum(modulation * omega, 1e-9)
            rounding = x / np.sinh(x) * 2.0 * j1(y) / y  # of a Fermi function's derivative, and of a half circle
            sharp = np.fft.rfft(density.columns(energy, parameters[:shapes]))
            columns: Array = np.vstack([np.fft.irfft(sharp * rounding, _GRID), np.ones(_GRID)])
            at: Array = energy
            if self.is_current:
                columns, at = np.vstack([np.cumsum(columns, axis=1) * step, np.ones(_GRID)]), energy + step / 2.0
            return np.stack([np.interp(self.bias_v, at, one) for one in columns], axis=1) * self.weights[:, None]

        def left(parameters: Array) -> Array:
            matrix = design(parameters)
            shares, *_ = np.linalg.lstsq(matrix, self.weights * self.values, rcond=1e-10)
            return np.asarray(matrix @ shares - self.weights * self.values)

        narrow, wide = math.log(0.1 / len(self.bias_v)), -math.log(_WIDEST)
        rounds = 1 if self.modulation is not None else 2
        lowest = np.array([*density.lowest, *[narrow] * rounds])
        highest = np.array([*density.highest, *[wide] * rounds])
        start = [np.clip([*shape, *[math.log(0.01)] * rounds], lowest, highest) for shape in density.starts]
        results = [least_squares(left, one, bounds=(lowest, highest), x_scale="jac", max_nfev=_CALLS) for one in start]
        best = min(results, key=lambda result: float(result.cost))
        rest, jacobian = np.asarray(best.fun), np.asarray(best.jac)
        squares = float(rest @ rest) / max(len(rest) - len(lowest) - _SHARES, 1)
        # noise of low frequency is alike in neighbouring points, and averages out the less
        alike = min(max(float(rest[1:] @ rest[:-1]) / max(float(rest @ rest), 1e-300), 0.0), _MOST_ALIKE)
        inflation = (1.0 + alike) / (1.0 - alike)
        covariance = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-12) * squares * inflation
        slopes = np.array([*density.gap, *[0.0] * rounds])
        error = math.sqrt(max(float(slopes @ covariance @ slopes), 0.0))
        return _Fit(float(slopes @ best.x) * self.extent_v, error * self.extent_v, density.name, squares, inflation)


def _bands(onset: float, curve: _Curve) -> _Density:
    slopes = tuple(bound * curve.extent_v for bound in _TRANSMISSION)

    def columns(energy: Array, parameters: Array) -> Array:
        step = energy[1] - energy[0]
        low, high, low_slope, high_slope = parameters
        found = []
        for beyond, slope in ((energy - high, high_slope), (low - energy, low_slope)):
            ends = np.maximum(beyond[:, None] + np.array([0.5, -0.5]) * step, 0.0) ** (onset + 1.0)
            found.append((ends[:, 0] - ends[:, 1]) / ((onset + 1.0) * step) * np.exp(slope * np.maximum(beyond, 0.0)))
        return np.stack(found)

    return _Density(
        f"onset {onset:g}",
        [(*curve.ends_of_gap(share), *[min(max(0.0, slopes[0]), slopes[1])] * 2) for share in _STARTS],
        (-0.5, -0.5, slopes[0], slopes[0]),
        (0.5, 0.5, slopes[1], slopes[1]),
        columns,
        (-1.0, 1.0, 0.0, 0.0),
    )


def _superconductor(curve: _Curve) -> _Density:
    zero = -curve.middle_v / curve.extent_v

    def columns(energy: Array, parameters: Array) -> Array:
        delta, broadening, offset = parameters
        at = energy - zero - offset - 1j * math.exp(broadening)
        density = np.abs(np.real(at / np.sqrt(at**2 - delta**2)))
        return np.stack([density, density * energy])

    return _Density(
        "superconductor",
        [((high - low) / 2.0, math.log(0.005), 0.0) for low, high in map(curve.ends_of_gap, _STARTS)],
        (0.5 / len(curve.bias_v), math.log(5e-4), -_OFF_ZERO),
        (0.5, math.log(0.2), _OFF_ZERO),
        columns,
        (2.0, 0.0, 0.0),
    )


def _both_ways(spectrum: Spectrum, role: str) -> tuple[Array, Array]:
    # the mean of both ways, if they are at the same biases: what the time of a sweep adds goes out with its direction
    bias, values = spectrum.of(_BIAS), spectrum.of(role)
    if not spectrum.has(role + _BACK):
        return bias, values
    bias_back, back = spectrum.of(_BIAS + _BACK), spectrum.of(role + _BACK)
    for step in (1, -1):
        if len(back) == len(values) and np.allclose(bias, bias_back[::step], rtol=0.0, atol=1e-3 * float(np.ptp(bias))):
            return bias, (values + back[::step]) / 2.0
    return bias, values


def _saturated(bias: Array, current: Array, modulation_v: float) -> NDArray[np.bool_]:
    # where the current stays at its largest value, and as far around as the modulation reaches
    most = current >= _CLIPPED * np.nanmax(current)
    if np.count_nonzero(current >= _STAYS * np.nanmax(current)) < _LEAST_CLIPPED:
        return np.zeros(len(most), dtype=np.bool_)
    reach = modulation_v + 1.5 * float(np.ptp(bias)) / len(bias)
    return np.asarray((np.abs(bias[:, None] - bias[most][None, :]) <= reach).any(axis=1))


def _variance(values: Array) -> Array:
    # from differences of the fourth order, which a smooth curve does not have: a constant, and a share of the value
    rough = np.square(np.convolve(values, [1.0, -4.0, 6.0, -4.0, 1.0], mode="valid")) / 70.0
    middle = np.abs(values[2:-2])
    small = middle <= np.median(middle)
    floor = max(float(np.median(rough[small])) / 0.455, 1e-12)
    share = max(float(np.median((rough / np.maximum(middle, 1e-6) ** 2)[~small])) / 0.455, 0.0)
    return np.asarray(floor + share * values**2)
