"""Evaluation of a spectrum: the number that a map shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from afspm.basics import ConfigError, InvalidValue, NoSuchItem
from afspm.components import Array
from afspm.model import Spectrum
from afspm.plugins.adaptive.band_gap import band_gap
from afspm.plugins.adaptive.pull_off import pull_off
from afspm.transport import find_object

_LEAST_POINTS: Final = 4
_MOST_ERROR: Final = 0.25
"""Largest standard error of the vertex of a parabola, as a share of the range of the bias."""
_MOST_SKEW: Final = 0.2
"""Largest cubic coefficient of a parabola, relative to its quadratic one, over the range of the bias."""
_MOST_ALIKE: Final = 0.98
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
    """Return the gap in eV: the distance of the edges of the density of states; of a superconductor 2 Delta.

    Raises: as `band_gap`.
    """
    return band_gap(spectrum).value_ev


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
    """Fit a parabola to the frequency shift over the bias, of each way.

    A drift of the frequency shift moves the vertex by its rate over the bias, divided by twice the curvature: one way
    alone does not show that. Of both ways it moves the vertices apart, as hysteresis does, and their mean stays.

    Raises:
        NoSuchItem: the spectrum has no bias or no frequency shift. InvalidValue: there is no parabola: too few points,
            no maximum, a skew course, or a vertex outside the sweep.
    """
    there = _parabola(_bias(spectrum), spectrum.of("frequency shift"))
    if not (spectrum.has("frequency shift, retrace") and spectrum.has("bias, retrace")):
        return there
    back = _parabola(spectrum.of("bias, retrace"), spectrum.of("frequency shift, retrace"))
    return KelvinParabola((there.vertex_v + back.vertex_v) / 2.0, math.hypot(there.error_v, back.error_v) / 2.0)


def _parabola(bias: Array, shift: Array) -> KelvinParabola:
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
    inflation = _inflation(shift - design @ with_cubic)
    error = math.sqrt(inflation * slopes @ covariance @ slopes)
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
    """Return the pull-off force in N: how far the lowest force of the way back is below the free cantilever.

    Raises: as `pull_off`.
    """
    return pull_off(spectrum).force_n


QUANTITIES: Final = {
    "gap": Evaluation("gap", "eV", "IV", gap_ev, (("bias",), ("conductance", "current"))),
    "contact_potential": Evaluation(
        "contact_potential", "V", "IV", contact_potential_v, (("bias",), ("frequency shift",))
    ),
    "adhesion": Evaluation("adhesion", "N", "force", adhesion_n, (("height",), ("force, retrace",))),
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


def _inflation(left: Array) -> float:
    # noise of low frequency is alike in neighbouring points, and averages out the less
    alike = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-300)
    return (1.0 + min(max(alike, 0.0), _MOST_ALIKE)) / (1.0 - min(max(alike, 0.0), _MOST_ALIKE))
