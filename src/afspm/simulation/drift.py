"""Thermal drift: translation, rotation and expansion of the sample under the tip.

The sign convention: drift is the displacement of the sample, so a feature that was at `x_sample` when the experiment
started is found at `x_tip = x_sample + drift(t)`. On a sample that turns or expands this holds at the fixed point
`about_m`; elsewhere `x_tip = turned(x_sample, t) + drift(t)`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from afspm.basics.errors import ConfigError, InvalidValue
from afspm.model.arrays import Array
from afspm.simulation import chance
from afspm.simulation.settings import check

_LONGEST_S = 2.0**20  # twelve days: the coarsest interval of the random walk
_LEVELS = 22  # halvings of it: below a quarter of a second the walk is linear
_FASTEST_M_PER_S = 1e-6  # a thousand times a bad evening's drift: finds slips of the unit, 60 um/s for 60 nm/min
_FASTEST_EXPANSION_PER_S = 1e-4  # beyond any sample, and still finite after twelve days


@dataclass(frozen=True)
class Relaxation:
    """An exponential relaxation after a temperature change or an approach: total_m * (1 - exp(-t / time_s))."""

    total_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    time_s: float = 3600.0

    def __post_init__(self) -> None:
        check(self, above_zero="time_s")


@dataclass(frozen=True)
class DriftSettings:
    """The sum of all drift contributions, each as (x, y, z) unless noted.

    Attributes:
        velocity_m_per_s: constant drift, at most 1e-6 m/s along each axis.
        speed_m_per_s: constant drift in x and y, added to it; its direction follows from the seed.
        relaxing: exponential relaxations since the start.
        walk_m_per_sqrt_hour: standard deviation in x and y of a random walk after one hour.
        walk_z_m_per_sqrt_hour: the same for z.
        daily_m: amplitude of a sine with a period of 24 hours.
        rotation_rad_per_s: constant rotation of the sample, counter-clockwise, in rad/s.
        expansion_per_s: relative growth of lengths per second, between -1e-4 and 1e-4.
        about_m: the fixed point (x, y) of rotation and expansion, in tip coordinates at the start.
    """

    velocity_m_per_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed_m_per_s: float = 0.0
    relaxing: tuple[Relaxation, ...] = field(default_factory=tuple)
    walk_m_per_sqrt_hour: float = 0.0
    walk_z_m_per_sqrt_hour: float = 0.0
    daily_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation_rad_per_s: float = 0.0
    expansion_per_s: float = 0.0
    about_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        check(self, from_zero="walk_m_per_sqrt_hour walk_z_m_per_sqrt_hour speed_m_per_s")
        for name in ("velocity_m_per_s", "speed_m_per_s"):
            along = np.ravel(getattr(self, name))
            if not max(map(abs, along)) <= _FASTEST_M_PER_S:
                what = f"{[float(one) for one in along]} is faster than {_FASTEST_M_PER_S:g} m/s"
                raise ConfigError(what, where=name, hint="1 nm/s is 1e-9, 1 nm/min is 17e-12")
        if not abs(self.expansion_per_s) <= _FASTEST_EXPANSION_PER_S:
            wanted = f"between {-_FASTEST_EXPANSION_PER_S:g} and {_FASTEST_EXPANSION_PER_S:g} 1/s"
            raise ConfigError(f"{self.expansion_per_s!r} is not {wanted}", where="expansion_per_s")


class Drift:
    """The drift as a function of time; the order of calls does not matter."""

    def __init__(self, settings: DriftSettings, seed: int, start_s: float) -> None:
        self._settings = settings
        self._seed = chance.subseed(seed, "drift")
        self._start_s = start_s
        angle = 2.0 * math.pi * float(chance.uniform(self._seed, 7))
        self._steady_m_per_s = settings.speed_m_per_s * np.array([math.cos(angle), math.sin(angle), 0.0])

    def at(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return (x, y, z) in m at experiment times, shape t.shape + (3,); zero at the start.

        Raises:
            InvalidValue: a time before the start.
        """
        since = self._since_s(t_s)[..., None]
        s = self._settings
        total = since * (np.asarray(s.velocity_m_per_s) + self._steady_m_per_s)
        for relaxation in s.relaxing:
            total = total - np.expm1(-since / relaxation.time_s) * np.asarray(relaxation.total_m)
        total = total + np.sin(since * (2.0 * math.pi / 86400.0)) * np.asarray(s.daily_m)
        scales = (s.walk_m_per_sqrt_hour, s.walk_m_per_sqrt_hour, s.walk_z_m_per_sqrt_hour)
        for axis, scale in enumerate(scales):
            if scale:
                total[..., axis] += scale / 60.0 * random_walk(self._seed + axis, since[..., 0])
        return np.asarray(total)

    def turn(self, t_s: ArrayLike) -> NDArray[np.complex128]:
        """Return rotation and scale about `about_m` as a complex factor, which is 1 at the start.

        Raises:
            InvalidValue: a time before the start.
        """
        rate = complex(self._settings.expansion_per_s, self._settings.rotation_rad_per_s)
        return np.asarray(np.exp(rate * self._since_s(t_s)))

    def turned(self, x_m: Array, y_m: Array, t_s: ArrayLike) -> tuple[Array, Array]:
        """Rotate and expand sample positions (x, y) to their state at times that broadcast with x and y."""
        return self._about(x_m, y_m, self.turn(t_s))

    def unturned(self, x_m: Array, y_m: Array, t_s: ArrayLike) -> tuple[Array, Array]:
        return self._about(x_m, y_m, 1.0 / self.turn(t_s))

    def _about(self, x_m: Array, y_m: Array, factor: NDArray[np.complex128]) -> tuple[Array, Array]:
        s = self._settings
        if s.rotation_rad_per_s == s.expansion_per_s == 0.0:
            return x_m, y_m  # exactly, without rounding
        pivot = complex(*s.about_m)
        moved = pivot + factor * (x_m + 1j * y_m - pivot)
        return moved.real, moved.imag

    def _since_s(self, t_s: ArrayLike) -> Array:
        since = np.asarray(t_s, dtype=np.float64) - self._start_s
        if since.size and not since.min() >= -1e-6:
            raise InvalidValue(f"drift is not known {-since.min():g} s before the start of the experiment")
        return np.maximum(since, 0.0)


class ScannerCompensation:
    """The displacement of a scanner with its own drift compensation, from a history of velocities."""

    def __init__(self, turns: Iterable[tuple[float, float, float, float, float]] = ()) -> None:
        self.turns = list(turns)  # (time, x, y at that time, velocity from then on)

    def set(self, velocity_m_per_s: tuple[float, float], t_s: float) -> None:
        """Set the velocity of the scanner from `t_s` on.

        Raises:
            InvalidValue: a time before the last change of velocity.
        """
        if self.turns and t_s < self.turns[-1][0]:
            raise InvalidValue(f"a velocity from {t_s:g} s on, after one from {self.turns[-1][0]:g} s on")
        x, y = self.at(t_s)[:2]
        velocity_x, velocity_y = velocity_m_per_s
        self.turns.append((t_s, float(x), float(y), float(velocity_x), float(velocity_y)))

    def at(self, t_s: ArrayLike) -> NDArray[np.float64]:
        """Return the compensating displacement (x, y, z) in m at experiment times, shape t.shape + (3,); z is 0."""
        t = np.asarray(t_s, dtype=np.float64)
        followed = np.zeros((*t.shape, 3))
        # a long night has thousands of velocities, and mostly the last is needed
        first = bisect_right(self.turns, t.min(initial=math.inf), key=lambda turn: turn[0]) - 1
        for since_s, x, y, velocity_x, velocity_y in self.turns[max(first, 0) :]:
            later = t >= since_s
            followed[later, 0] = x + velocity_x * (t[later] - since_s)
            followed[later, 1] = y + velocity_y * (t[later] - since_s)
        return followed


def random_walk(seed: int, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a Brownian path at any times t >= 0: zero at t = 0, variance 1 per second.

    Lévy's construction: the ends of a long interval first, then midpoints between midpoints, each drawn by
    its index; so a value needs no history.
    """
    interval = np.floor(t_s / _LONGEST_S)
    ends = np.arange(int(interval.max(initial=0.0)) + 2)
    steps = chance.normal(seed, 0, ends) * math.sqrt(_LONGEST_S)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    index = interval.astype(np.int64)
    left, right = path[index], path[index + 1]
    position = t_s / _LONGEST_S - interval
    width_s = _LONGEST_S
    for level in range(1, _LEVELS + 1):
        middle = (left + right) / 2 + math.sqrt(width_s) / 2 * chance.normal(seed, level, index)
        after = position >= 0.5
        left, right = np.where(after, middle, left), np.where(after, right, middle)
        position = 2.0 * position - after
        index = 2 * index + after
        width_s /= 2
    walked: NDArray[np.float64] = left + (right - left) * position
    return walked
