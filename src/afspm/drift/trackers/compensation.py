"""How tip coordinates follow the sample where a controller compensates drift by itself."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Compensation:
    """A velocity that changes in steps; none at all to begin with.

    Attributes:
        changes: (since when in s, v_x, v_y in m/s), in the order of time.
    """

    changes: tuple[tuple[float, float, float], ...] = ()

    def velocity_m_s(self, time_s: float) -> Array:
        """(2,) at a time."""
        velocity = (0.0, 0.0)
        for since_s, x, y in self.changes:
            if since_s <= time_s:
                velocity = (x, y)
        return np.array(velocity)

    def followed_m(self, from_s: float, to_s: float) -> Array:
        """(2,) by how much tip coordinates have moved between two times, negative if they are exchanged."""
        start_s, end_s = min(from_s, to_s), max(from_s, to_s)
        edges = [start_s, *(since_s for since_s, _, _ in self.changes if start_s < since_s < end_s), end_s]
        parts = [self.velocity_m_s(a) * (b - a) for a, b in itertools.pairwise(edges)]
        followed: Array = np.sum(parts, axis=0) * (1.0 if to_s >= from_s else -1.0)
        return followed

    def changed(self, since_s: float, velocity_m_s: Array, *, needed_s: float) -> Compensation:
        """With another velocity from a time on, and without what nobody asks for who asks about `needed_s` or later."""
        before = [change for change in self.changes if change[0] < since_s]
        while len(before) > 1 and before[1][0] <= needed_s:
            del before[0]
        return Compensation((*before, (float(since_s), float(velocity_m_s[0]), float(velocity_m_s[1]))))

    @classmethod
    def from_list(cls, changes: Iterable[Iterable[float]]) -> Compensation:
        """From `changes` as JSON has them."""
        return cls(tuple((float(since_s), float(x), float(y)) for since_s, x, y in changes))
