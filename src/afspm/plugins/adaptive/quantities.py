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
from afspm.transport import find_object

_EDGE: Final = (0.2, 0.65)
"""Limits of the fit to a band edge, as shares of the largest conductance on its side. Between them the conductance
rises as the square root of the energy beyond the edge."""
_LEAST_POINTS: Final = 4


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

    At an edge the squared conductance rises linearly, so a line through the squares meets zero at the edge, also where
    temperature rounds the edge itself.

    Raises:
        NoSuchItem: the spectrum has no bias, or neither conductance nor current. InvalidValue: it shows no band edges.
    """
    if (unit := spectrum.si_unit_of("bias")) not in ("V", ""):
        raise InvalidValue(f"the bias is in {unit}")
    bias = spectrum.of("bias")
    order = np.argsort(bias)
    bias = bias[order]
    if spectrum.has("conductance"):
        conductance = spectrum.of("conductance")[order]
    else:
        conductance = np.gradient(spectrum.of("current")[order], bias)
    width = max(1, len(bias) // 50)
    smoothed = np.convolve(conductance, np.full(width, 1.0 / width), mode="same")
    lowest = width + int(np.argmin(smoothed[width : len(bias) - width]))
    right = _edge(bias[lowest:], smoothed[lowest : len(bias) - width])
    left = _edge(-bias[lowest::-1], smoothed[lowest : width - 1 : -1])
    return right + left


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


def _edge(outwards: Array, conductance: Array) -> float:
    # `outwards` rises from the middle of the gap; the result is the bias of the edge
    conductance = conductance[: len(outwards)]
    outwards = outwards[: len(conductance)]
    highest = float(conductance.max(initial=0.0))
    above = np.flatnonzero(conductance > _EDGE[0] * highest)
    beyond = np.flatnonzero(conductance > _EDGE[1] * highest)
    if highest <= 0.0 or not len(above) or not len(beyond) or beyond[0] - above[0] < _LEAST_POINTS:
        raise InvalidValue("the curve has no band edge", hint="sweep the bias farther, with more points")
    part = slice(int(above[0]), int(beyond[0]))
    slope, offset = np.polyfit(outwards[part], conductance[part] ** 2, 1)
    if slope <= 0.0:
        raise InvalidValue("the curve has no band edge", hint="average more sweeps")
    return float(-offset / slope)
