"""How drift may move: velocities that wander and fade, many kinds of them side by side.

Each model is an Ornstein-Uhlenbeck velocity, dv = -v dt / tau + sqrt(q) dW, the position its integral and a little
random walk besides (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sections 6.2 and 8.2). Both axes move alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SHORT = 1e-2  # of the fading time: below, differences of exponentials lose their digits and a series is exact enough


@dataclass(frozen=True, eq=False)
class Models:
    """n kinds of motion.

    Attributes:
        density_m2_s3: (n,) q, spectral density of the acceleration.
        fading_per_s: (n,) 1 / tau; 0 for a velocity that stays.
        walk_m2_s: variance that the position gains in a second by itself.
    """

    density_m2_s3: Array
    fading_per_s: Array
    walk_m2_s: float

    def over(self, step_s: float) -> tuple[Array, Array]:
        """What a time does to a state (x, y, v_x, v_y): transition (n, 4, 4) and covariance gained (n, 4, 4).

        A negative time goes back in a straight line, and gains as much.
        """
        a, q, t = self.fading_per_s, self.density_m2_s3, abs(step_s)
        reach_s = np.full_like(a, step_s)  # by which the velocity has moved the position
        left = np.ones_like(a)  # of the velocity
        if step_s > 0.0:
            left = np.exp(-a * t)
            reach_s = np.where(a > 0.0, -np.expm1(-a * t) / np.where(a > 0.0, a, 1.0), t)
        position, both, velocity = _gained(a, t)
        transition = np.zeros((len(a), 2, 2))
        transition[:, 0, 0], transition[:, 0, 1], transition[:, 1, 1] = 1.0, reach_s, left
        gained = np.zeros_like(transition)
        gained[:, 0, 0], gained[:, 1, 1] = q * position + self.walk_m2_s * t, q * velocity
        gained[:, 0, 1] = gained[:, 1, 0] = q * both * (1.0 if step_s >= 0.0 else -1.0)
        return _both_axes(transition), _both_axes(gained)


def _gained(a: Array, t: float) -> tuple[Array, Array, Array]:
    """Variance of position, covariance with and variance of velocity after a time, for q = 1."""
    x = a * t
    short = x < _SHORT
    b = np.where(short, 1.0, a)
    fade = np.exp(-np.where(short, 0.0, x))
    position = np.where(
        short, t**3 / 3 * (1 - 3 / 4 * x + 7 / 20 * x**2), (t - 2 * (1 - fade) / b + (1 - fade**2) / (2 * b)) / b**2
    )
    both = np.where(short, t**2 / 2 * (1 - x + 7 / 12 * x**2), (1 - fade) ** 2 / (2 * b**2))
    velocity = np.where(short, t * (1 - x + 2 / 3 * x**2), (1 - fade**2) / (2 * b))
    return position, both, velocity


def _both_axes(one: Array) -> Array:
    """(n, 2, 2) of (position, velocity) as (n, 4, 4) of (x, y, v_x, v_y)."""
    both = np.zeros((len(one), 4, 4))
    both[:, 0::2, 0::2] = one
    both[:, 1::2, 1::2] = one
    return both
