"""How well the z feedback follows, from its error signal; and where better gains may be found."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.errors import InvalidValue

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorShares:
    """Shares of a scan's pixels, 0 to 1, where the error signal is too large.

    Attributes:
        over: the signal lies above the setpoint by more than the threshold: in tapping, the tip is off the sample.
        under: below it by more: it presses too hard.
    """

    over: float
    under: float

    @property
    def total(self) -> float:
        return self.over + self.under


def error_shares(signal: Array, setpoint: float | None, threshold: float) -> ErrorShares:
    """The shares of one scan.

    Args:
        signal: what the feedback holds at the setpoint, the amplitude, say; NaN where nothing was measured.
        setpoint: in the same unit; None: the signal's median, which it is at unless the feedback is far off.
        threshold: of the error, as a share of the setpoint.

    Raises:
        InvalidValue: nothing was measured, or the setpoint is zero.
    """
    there = signal[np.isfinite(signal)]
    if not there.size:
        raise InvalidValue("an error signal without a value")
    centre = float(np.median(there)) if setpoint is None else setpoint
    if centre == 0.0:
        raise InvalidValue("a setpoint of zero has no relative error")
    error = (there - centre) / abs(centre)
    return ErrorShares(float(np.mean(error > threshold)), float(np.mean(error < -threshold)))


def gain_search(
    start: float, factor: float, lowest: float, highest: float, most_tries: int
) -> Generator[float, float, float]:
    """Look for the gain of the smallest score by multiplying: up as long as it gets better, else down.

    Yields gains to try (the start first), is sent the score of each, and returns the best.

    Args:
        factor: of one step, above 1.
        lowest, highest: never left.
        most_tries: how many may be tried in all.
    """
    best, best_score = start, (yield start)
    tried = 1
    for step in (factor, 1.0 / factor):
        began = best
        while tried < most_tries and lowest <= best * step <= highest:
            score = yield best * step
            tried += 1
            if score >= best_score:
                break
            best, best_score = best * step, score
        if best != began:
            break  # the other way lies what was left for it
    return best
