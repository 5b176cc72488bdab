"""Evaluation of a spectrum: the number that a map shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Final

import numpy as np
from scipy.optimize import curve_fit

from afspm.basics import ConfigError, InvalidValue, NoSuchItem
from afspm.components import Array
from afspm.model import Spectrum
from afspm.transport import find_object

_EDGE: Final = (0.2, 0.65)
"""Shares of the largest conductance on the side of a band edge. Up to the second the conductance rises as the square
root of the energy beyond the edge; between both, broadening hardly matters."""
_LEAST_POINTS: Final = 4
_CLIPPED: Final = 0.99
"""Share of the largest current above which the preamplifier may be saturated."""
_FAR: Final = 30.0
"""In widths of the broadening: where a broadened square root is a square root."""
_MOST_ERROR: Final = 0.25
"""Largest standard error of the vertex of a parabola, as a share of the range of the bias."""
_MOST_SKEW: Final = 0.2
"""Largest cubic coefficient of a parabola, relative to its quadratic one, over the range of the bias."""
_LEAST_CURVED: Final = 5.0
"""Least curvature of a parabola, in its standard errors."""


@dataclass(frozen=True)
class Evaluation:
    """A quantity: its name and unit, the kind of spectrum that shows it (None: any), and the function of a spectrum.

    Attributes:
        needs: the roles of the variables that the function reads; of several in one tuple it reads one.
    """

    name: str
    unit: str
    kind: str | None
    function: Callable[[Spectrum], float]
    needs: tuple[tuple[str, ...], ...] = ()

    def of(self, spectrum: Spectrum) -> float:
        """Return the value of the quantity in a spectrum.

        Raises:
            InvalidValue: the curve does not show the quantity, or the function raises or returns no finite number.
        """
        try:
            value = float(self.function(spectrum))
        except InvalidValue:
            raise
        except NoSuchItem as error:
            raise InvalidValue(f"{self.name}: {error.what}", hint=error.hint) from error
        except Exception as error:  # a user's function may raise anything for an odd curve, and the map goes on
            raise InvalidValue(f"{self.name} of the curve: {type(error).__name__}: {error}") from error
        if not math.isfinite(value):
            raise InvalidValue(f"{self.name} of the curve is {value}")
        return value


def gap_ev(spectrum: Spectrum) -> float:
    """Return the band gap in eV: the distance of the band edges in dI/dV.

    At an edge the conductance rises as the square root of the energy. Temperature, modulation and steps of the bias
    round it by a width that is fitted with the edge: a line through the squares alone would lie outside the edges by
    some ten meV at room temperature.

    Raises:
        NoSuchItem: the spectrum has no bias, or neither conductance nor current. InvalidValue: it shows no band edges.
    """
    bias = _bias(spectrum)
    order = np.argsort(bias)
    bias = bias[order]
    current = spectrum.of("current")[order] if spectrum.has("current") else None
    if spectrum.has("conductance"):
        conductance = spectrum.of("conductance")[order]
    else:
        conductance = np.gradient(spectrum.of("current")[order], bias)
    if current is not None:  # a saturated preamplifier passes no modulation
        passed = np.abs(current) < _CLIPPED * np.abs(current).max(initial=0.0)
        bias, conductance = bias[passed], conductance[passed]
    width = 2 * (len(bias) // 100) + 1
    if len(bias) <= 2 * width:
        raise InvalidValue("the curve has no band edge", hint="sweep the bias farther, with more points")
    smoothed = np.convolve(conductance, np.full(width, 1.0 / width), mode="same")
    lowest = width + int(np.argmin(smoothed[width : len(bias) - width]))
    right = _edge(bias[lowest:-width], conductance[lowest:-width], smoothed[lowest:-width])
    left = _edge(
        -bias[lowest : width - 1 : -1], conductance[lowest : width - 1 : -1], smoothed[lowest : width - 1 : -1]
    )
    return right + left


@dataclass(frozen=True)
class KelvinParabola:
    """The parabola of the frequency shift over the bias.

    Attributes:
        vertex_v: bias at the vertex: the contact potential.
        error_v: standard error of the vertex, from the scatter around the parabola.
    """

    vertex_v: float
    error_v: float


def kelvin_parabola(spectrum: Spectrum) -> KelvinParabola:
    """Fit a parabola to the frequency shift over the bias.

    Raises:
        NoSuchItem: the spectrum has no bias or no frequency shift. InvalidValue: there is no parabola: too few points,
            no maximum, a skew course, or a vertex outside the sweep.
    """
    bias, shift = _bias(spectrum), spectrum.of("frequency shift")
    good = np.isfinite(bias) & np.isfinite(shift)
    bias, shift = bias[good], shift[good]
    extent = float(np.ptp(bias)) if len(bias) else 0.0
    if len(bias) < 2 * _LEAST_POINTS or extent == 0.0:
        hint = f"sweep the bias with {2 * _LEAST_POINTS} points or more"
        raise InvalidValue("the frequency shift is no parabola: too few points", hint=hint)
    middle = float(bias.min() + bias.max()) / 2.0
    scaled = (bias - middle) / extent
    design = np.stack([np.ones(len(scaled)), scaled, scaled**2, scaled**3], axis=1)
    fit, covariance = _least_squares(design[:, :3], shift)
    with_cubic, cubic_covariance = _least_squares(design, shift)
    _, linear, square = fit
    if not square < -_LEAST_CURVED * math.sqrt(covariance[2, 2]):
        raise InvalidValue("the frequency shift is no parabola: it has no maximum", hint="sweep the bias farther")
    vertex = -linear / (2.0 * square)
    slopes = np.array([0.0, -1.0 / (2.0 * square), linear / (2.0 * square**2)])
    error = math.sqrt(slopes @ covariance @ slopes)
    if not (abs(vertex) <= 0.5 and error < _MOST_ERROR):
        raise InvalidValue("the vertex of the parabola is outside the sweep", hint="move the range of the bias")
    odd = abs(float(with_cubic[3]))
    if odd > max(_LEAST_CURVED * math.sqrt(cubic_covariance[3, 3]), _MOST_SKEW * abs(float(square))):
        raise InvalidValue("the frequency shift is no parabola: it is skew", hint="keep z and amplitude constant")
    return KelvinParabola(middle + extent * vertex, extent * error)


def contact_potential_v(spectrum: Spectrum) -> float:
    """Return the contact potential in V: the bias at the vertex of the Kelvin parabola.

    Raises: as `kelvin_parabola`.
    """
    return kelvin_parabola(spectrum).vertex_v


def adhesion_n(spectrum: Spectrum) -> float:
    """Return the pull-off force in N: the negative of the lowest force while the tip withdraws.

    Raises:
        NoSuchItem: the spectrum has no force, or no way back: the approach has its lowest force at the snap-in.
    """
    force = spectrum.of("force, retrace")
    if (unit := spectrum.si_unit_of("force, retrace")) != "N":
        raise InvalidValue(f"the force is in {unit or 'no unit'}", hint="calibrate the cantilever at the controller")
    return -float(force.min())


QUANTITIES: Final = {
    "gap": Evaluation("gap", "eV", "IV", gap_ev, (("bias",), ("conductance", "current"))),
    "contact_potential": Evaluation(
        "contact_potential", "V", "IV", contact_potential_v, (("bias",), ("frequency shift",))
    ),
    "adhesion": Evaluation("adhesion", "N", "force", adhesion_n, (("force, retrace",),)),
}


def evaluation(quantity: str, unit: str = "", kind: str | None = None) -> Evaluation:
    """Return the evaluation of a named quantity, or of a function "module.name".

    Args:
        unit: unit of the function's values; empty for a named quantity.
        kind: kind of spectrum; None: the quantity's own, or any for a function.

    Raises:
        ConfigError: there is no such quantity or function, or a unit is given for a named quantity.
    """
    if quantity in QUANTITIES:
        known = QUANTITIES[quantity]
        if unit:
            raise ConfigError(f"{quantity} is in {known.unit}", where="unit", hint="leave `unit` out")
        return replace(known, kind=kind or known.kind)
    if "." not in quantity:
        hint = f"one of {', '.join(QUANTITIES)}, or a function of a spectrum as module.name"
        raise ConfigError(f"no quantity is named {quantity!r}", where="quantity", hint=hint)
    function = find_object(quantity, "quantity")
    if not callable(function):
        raise ConfigError(f"{quantity} is not a function", where="quantity", hint="it is given a Spectrum")
    return Evaluation(quantity.rpartition(".")[2], unit, kind, function)


def _bias(spectrum: Spectrum) -> Array:
    if (unit := spectrum.si_unit_of("bias")) not in ("V", ""):
        raise InvalidValue(f"the bias is in {unit}")
    return spectrum.of("bias")


def _least_squares(design: Array, values: Array) -> tuple[Array, Array]:
    # coefficients and their covariance, from the scatter of the values around the fit
    inverse = np.linalg.inv(design.T @ design)
    fit = inverse @ design.T @ values
    variance = float(np.square(values - design @ fit).sum()) / max(len(values) - design.shape[1], 1)
    return fit, inverse * variance


@cache
def _rounded() -> tuple[Array, Array]:
    # the square root of x, rounded by the derivative of a Fermi function with a width of 1
    step = 0.02
    x = np.arange(-_FAR, _FAR, step)
    wide = np.arange(-2.0 * _FAR, 2.0 * _FAR, step)
    kernel = 0.25 / np.cosh(x / 2.0) ** 2 * step
    return x, np.interp(x, wide, np.convolve(np.sqrt(np.maximum(wide, 0.0)), kernel, mode="same"))


def _rounded_root(x: Array) -> Array:
    # beyond the table, the series of Sommerfeld
    far = np.maximum(x, 1.0)
    return np.where(x < 0.8 * _FAR, np.interp(x, *_rounded()), np.sqrt(far) * (1.0 - math.pi**2 / 24.0 / far**2))


def _edge(outwards: Array, conductance: Array, smoothed: Array) -> float:
    # `outwards` rises from the middle of the gap; the result is the bias of the edge
    highest = float(smoothed.max(initial=0.0))
    above = np.flatnonzero(smoothed > _EDGE[0] * highest)
    beyond = np.flatnonzero(smoothed > _EDGE[1] * highest)
    if highest <= 0.0 or not len(above) or not len(beyond) or beyond[0] - above[0] < _LEAST_POINTS:
        raise InvalidValue("the curve has no band edge", hint="sweep the bias farther, with more points")
    part = slice(int(above[0]), int(beyond[0]))
    slope, offset = np.polyfit(outwards[part], smoothed[part] ** 2, 1)
    if slope <= 0.0:
        raise InvalidValue("the curve has no band edge", hint="average more sweeps")
    x, y = outwards[: beyond[0]], conductance[: beyond[0]] / highest
    step, extent = float(np.diff(x).mean()), float(np.ptp(outwards))

    def model(x: Array, edge: float, width: float, root: float, floor: float) -> Array:
        return floor + root * math.sqrt(width) * _rounded_root((x - edge) / width)

    start = (-offset / slope, 0.02 * extent, math.sqrt(slope) / highest, 0.0)
    bounds = ((x[0], 0.1 * step, 0.0, -0.2), (x[-1], extent / 20.0, np.inf, 0.2))
    try:
        found, _ = curve_fit(model, x, y, np.clip(start, *bounds), bounds=bounds)
    except (RuntimeError, ValueError) as error:
        raise InvalidValue("the curve has no band edge", hint="average more sweeps") from error
    return float(found[0])
