"""The sensor of non-contact microscopy: it oscillates near the sample, whose attraction shifts its resonance.

Of a sphere that is attracted by van der Waals forces, with any amplitude A, a distance d from the sample at the nearest
point of its way: shift = -f H R / (6 k (d (d + 2 A))^(3/2)) (Giessibl 1997).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from afspm.simulation.fields import Array
from afspm.simulation.settings import check


@dataclass(frozen=True)
class SensorSettings:
    """The sensor of the mode "frequency-shift".

    Attributes:
        resonance_hz: far from the sample.
        oscillation_m: amplitude, which is kept constant.
        radius_m: of the apex that is attracted.
        hamaker_j: of the attraction.
        contact_m: nearer than this the shift grows no more.
    """

    resonance_hz: float = 300e3
    spring_n_per_m: float = 40.0
    oscillation_m: float = 5e-9
    radius_m: float = 8e-9
    hamaker_j: float = 1e-19
    contact_m: float = 0.3e-9

    def __post_init__(self) -> None:
        check(self, above_zero="resonance_hz spring_n_per_m oscillation_m radius_m hamaker_j contact_m")

    def shift_hz(self, distance_m: Array) -> Array:
        """Return the frequency shift at distances from the sample: negative."""
        nearest = np.maximum(distance_m, self.contact_m)
        return np.asarray(-self._strength / (nearest * (nearest + 2.0 * self.oscillation_m)) ** 1.5)

    def distance_m(self, shift_hz: float) -> float:
        """Return the distance at which the resonance is shifted so far; `shift_hz` is negative."""
        squared = (self._strength / -shift_hz) ** (2.0 / 3.0)
        return math.sqrt(self.oscillation_m**2 + squared) - self.oscillation_m

    def slope_hz_per_m(self, distance_m: float) -> float:
        """Return how much the shift changes with the distance: positive."""
        both = distance_m + 2.0 * self.oscillation_m
        return float(1.5 * self._strength * (distance_m + both) / (distance_m * both) ** 2.5)

    @property
    def largest_hz(self) -> float:
        """The shift in contact, which no other is below."""
        return float(self.shift_hz(np.zeros(())))

    @property
    def _strength(self) -> float:
        return self.resonance_hz * self.hamaker_j * self.radius_m / (6.0 * self.spring_n_per_m)
