"""Detection of strong noise and of streaks, as of a dirty tip, in what trace and retrace don't share. Pure.

Noise is strong if most frequencies have several times their usual power: a hum fills few. A line has a streak if it
steps up or down far beyond the changes in the rest of the line. A hum changes as much everywhere. A streak that covers
half of the line widens the spread of its heights, but not of its changes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from afspm.components import SD_PER_MAD, Array
from afspm.plugins.line_watch.registration import RowFit

NEWEST = 10  # lines with strong noise
NOISIER = 2.0  # times the usual standard deviation: a row less its template has both noises, so noise x 3 is x 2.2
STREAKED, OF_LINES = 5, 16  # lines: a scar now and then is none
SIDE_PX, LEAST_SIDES = 8, 16  # on each side of a step: the shortest streak; fewer in a short line
BEYOND = 5.0  # times the spread of the line's own changes, and at least
LEAST = 2.5  # times the usual standard deviation: five spreads of such a change in white noise


class Disturbances:
    """A watch on the noise's part of successive lines.

    Args:
        flat_m, per_slope: see `PairStatistics`.
        usual: mean square of the noise's part in good scans.
    """

    def __init__(self, flat_m: float, per_slope: float, usual: float) -> None:
        self._flat_m, self._per_slope, self._usual = flat_m, per_slope, math.sqrt(usual)
        self._lines: list[tuple[int, float, bool]] = []  # row, size of the noise, whether a streak

    def add(self, row: int, fits: Sequence[RowFit]) -> tuple[int, str] | None:
        """Add both recordings of a line; return the first row of a disturbance and its name, or None."""
        first, second = (fit.residual / np.hypot(self._flat_m, self._per_slope * fit.steepness) for fit in fits)
        noise = (first - second)[np.isfinite(first - second)] / (math.sqrt(2.0) * self._usual)
        # the median power of white noise is ln 2 of its mean
        size = math.sqrt(float(np.median(np.abs(np.fft.rfft(noise)) ** 2)) / noise.size / math.log(2.0))
        self._lines = [*self._lines, (row, size, _is_streaked(noise))][-OF_LINES:]
        streaked = [row for row, _, is_streaked in self._lines if is_streaked]
        if len(streaked) >= STREAKED:
            return streaked[0], f"{len(streaked)} of {len(self._lines)} lines have streaks"
        newest = self._lines[-NEWEST:]
        usual = float(np.median([size for _, size, _ in newest]))
        if len(newest) == NEWEST and usual >= NOISIER:
            since = next(row for row, size, _ in newest if size >= NOISIER)
            return since, f"the noise is {usual:.1f} times the usual difference of two scans"
        return None


def _is_streaked(noise: Array) -> bool:
    side = max(1, min(SIDE_PX, noise.size // LEAST_SIDES))
    sums = np.append(0.0, np.cumsum(noise))
    means = (sums[side:] - sums[:-side]) / side
    steps = np.abs(means[side:] - means[:-side])
    return bool(steps.size and steps.max() > max(LEAST, BEYOND * SD_PER_MAD * float(np.median(steps))))
