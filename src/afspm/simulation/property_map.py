"""A quantity that varies over the sample: a map with known truth, which spectra can reveal.

Adaptive measuring needs a continuous quantity, where a surface knows only two materials. The map is independent of the
surface, so any surface can carry it, and belongs to the sample, so it drifts with it. Creep of the scanner does not
displace spectra.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from afspm.basics.errors import ConfigError
from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.fields import smooth_field
from afspm.simulation.settings import check, one_of
from afspm.simulation.spectra import ForceSettings, IVSettings
from afspm.simulation.surfaces.relief import Sites

KINDS = ("none", "smooth", "spotty")


@dataclass(frozen=True)
class Quantity:
    """A measurable quantity: the kind of spectrum that reveals it, its unit and its usual range."""

    spectrum: str
    unit: str
    low: float
    high: float


QUANTITIES: Final = {
    "gap": Quantity("IV", "eV", 0.4, 1.4),
    "modulus": Quantity("force", "Pa", 1e9, 6e9),
    "adhesion": Quantity("force", "J/m^2", 0.02, 0.1),
    "contact_potential": Quantity("IV", "V", -0.3, 0.3),
}
_STEEPNESS = 1.6  # of the logistic curve that keeps a field within its range: 90 % of it is used
_REACH = 3.0  # of a spot, in its half-widths: less than 0.002 of its height is left there


@dataclass(frozen=True)
class PropertyMapSettings:
    """A quantity of spectra that varies over the sample, instead of depending on the two materials.

    Attributes:
        kind: "none", "smooth" (hills and valleys everywhere) or "spotty" (round spots on a uniform background).
        quantity: "gap" of I(V) curves in eV, "modulus" of force curves in Pa, or their "adhesion" in J/m^2, or the
            "contact_potential" in V, which an oscillating sensor feels in I(V) curves and in scans.
        low, high: range of the quantity, in its unit; if both are equal, the usual range of the quantity.
        size_m: width of hills, or mean width of spots at half their height.
        spacing_m: mean distance of spots.
        spot_exponent: shape of spots: 2 for Gaussian spots, larger values for flat spots with a steep edge.
    """

    kind: str = "none"
    quantity: str = "gap"
    low: float = 0.0
    high: float = 0.0
    size_m: float = 150e-9
    spacing_m: float = 400e-9
    spot_exponent: float = 2.0

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, "kind")
        one_of(self.quantity, QUANTITIES, "quantity")
        check(self, above_zero="size_m spacing_m", from_zero="" if self.quantity == "contact_potential" else "low")
        if self.high < self.low:
            raise ConfigError(f"{self.high!r} is below low = {self.low!r}", where="high")
        if not 2.0 <= self.spot_exponent <= 20.0:
            raise ConfigError(f"{self.spot_exponent!r} is not between 2 and 20", where="spot_exponent")

    @property
    def range(self) -> tuple[float, float]:
        """The range of the quantity, in its unit."""
        usual = QUANTITIES[self.quantity]
        return (usual.low, usual.high) if self.low == self.high else (self.low, self.high)


class PropertyMap:
    """An unbounded map, determined by its seed.

    Attributes:
        is_on: True if there is a map; otherwise spectra depend on the two materials.
        quantity: name of the quantity.
        unit: unit of the quantity.
    """

    def __init__(self, settings: PropertyMapSettings, seed: int) -> None:
        self._settings = settings
        self._seed = chance.subseed(seed, "property map") % 2**62
        self.is_on = settings.kind != "none"
        self.quantity, self.unit = settings.quantity, QUANTITIES[settings.quantity].unit

    def at(self, x_m: ArrayLike, y_m: ArrayLike) -> Array:
        """Return the true values at sample coordinates, in the broadcast shape of x and y."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        flat_x, flat_y = x.reshape(-1, 1), y.reshape(-1, 1)
        share = self._hills(flat_x, flat_y) if self._settings.kind == "smooth" else self._spots(flat_x, flat_y)
        low, high = self._settings.range
        return low + (high - low) * share.reshape(x.shape)

    def on_iv(self, settings: IVSettings, material: float, x_m: float, y_m: float) -> tuple[IVSettings, float]:
        """Return the settings and the material of an I(V) curve at a position of the sample."""
        if not (self.is_on and self.quantity == "gap"):
            return settings, material
        return replace(settings, gap_ev=float(self.at(x_m, y_m))), 0.0  # material 0 is the one with a gap

    def on_force(self, settings: ForceSettings, x_m: float, y_m: float) -> ForceSettings:
        """Return the settings of a force curve at a position of the sample."""
        if not (self.is_on and self.quantity in ("modulus", "adhesion")):
            return settings
        pair = (float(self.at(x_m, y_m)),) * 2
        if self.quantity == "modulus":
            return replace(settings, modulus_pa=pair)
        return replace(settings, adhesion_j_per_m2=pair)

    def _hills(self, x_m: Array, y_m: Array) -> Array:
        field = smooth_field(self._seed, x_m, y_m, self._settings.size_m)
        return np.asarray(1.0 / (1.0 + np.exp(-_STEEPNESS * field)))

    def _spots(self, x_m: Array, y_m: Array) -> Array:
        # overlapping spots saturate, so that no value leaves the range
        half_m = self._settings.size_m / 2
        sites = Sites.within(self._seed, x_m, y_m, 2.0 * _REACH * half_m, self._settings.spacing_m)
        heights = 0.5 + 0.5 * chance.uniform(self._seed + 5, sites.key)
        widths_m = half_m * np.clip(np.exp(0.2 * chance.normal(self._seed + 6, sites.key)), 0.7, 1.4)
        left = np.ones(x_m.shape)
        for site_x_m, site_y_m, height, width_m in zip(sites.x_m, sites.y_m, heights, widths_m, strict=True):
            square = ((x_m - site_x_m) ** 2 + (y_m - site_y_m) ** 2) / width_m**2
            left *= 1.0 - height * 0.5 ** (square ** (self._settings.spot_exponent / 2))
        return 1.0 - left
