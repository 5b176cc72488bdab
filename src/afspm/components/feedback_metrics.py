"""Quality of the z feedback, from its error signal and the height, and a search for the gain."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from enum import Enum

import numpy as np

from afspm.basics.errors import InvalidValue
from afspm.model.arrays import Array

_SMALLEST_CURRENT = 0.01  # of the setpoint: smaller values are noise, and may have no logarithm
_SIGNIFICANT = 4.0  # standard deviations of white noise
_CLOSE = 1.1  # ratio of two gains below which the search ends
_SAME_MIDDLE = 0.1  # relative difference of two medians that count as equal
_SWING = 0.2  # least slope of height on error for an oscillation


class FeedbackQuality(Enum):
    """Quality with which the feedback follows the sample."""

    WELL = "follows"
    BARELY = "barely follows"
    TOO_SLOW = "is too slow"
    OSCILLATES = "oscillates"

    @property
    def is_good(self) -> bool:
        return self in (FeedbackQuality.WELL, FeedbackQuality.BARELY)


@dataclass(frozen=True)
class FeedbackError:
    """Measures of the error signal of one scan.

    Attributes:
        over: share of the pixels, 0 to 1, where the signal exceeds the setpoint by more than the threshold: in tapping
            mode the tip is off the sample there.
        under: the same below the setpoint: in tapping mode the tip presses too hard there.
        missed: relief in the error divided by relief in the height; above one if the loop oscillates, or is far too
            slow.
        swing: slope of the height's changes on the error's, both in m: one or more if the tip oscillates above the
            sample, zero or less if it lags behind.
        middle: median of the error signal.
    """

    over: float
    under: float
    missed: float = 0.0
    swing: float = 0.0
    middle: float = 0.0

    @property
    def share(self) -> float:
        """Share of the pixels beyond the threshold, on either side of the setpoint."""
        return self.over + self.under

    def __str__(self) -> str:
        relief = f"{self.missed:.0%} of the relief" if self.missed <= 1.0 else f"{self.missed:.2g} times the relief"
        return f"{self.share:.0%} of the pixels beyond the threshold, {relief} of the height in the error"


@dataclass(frozen=True)
class FeedbackLimits:
    """Limits for a good feedback: share of pixels beyond the threshold, and share of the relief in the error."""

    pixels: float = 0.1
    relief: float = 0.2

    def judge(self, error: FeedbackError) -> FeedbackQuality:
        """Return the quality of the feedback in one scan; WELL needs half the limits, as a margin."""
        worst = max(error.share / self.pixels, error.missed / self.relief)
        if worst <= 1.0:
            return FeedbackQuality.WELL if worst <= 0.5 else FeedbackQuality.BARELY
        is_swinging = error.swing > _SWING and error.share > self.pixels
        return FeedbackQuality.OSCILLATES if is_swinging else FeedbackQuality.TOO_SLOW

    def is_held_elsewhere(self, error: FeedbackError, at_lower_gain: FeedbackError) -> bool:
        """Return whether the feedback holds the signal, but at another value than the setpoint.

        An integral gain leaves no constant error, and a higher one leaves less. So the setpoint and the channel are
        calibrated differently if the height follows while the same error stays at a higher gain.
        """
        both = (error, at_lower_gain)
        is_off = all(max(one.over, one.under) > 0.5 and 0.0 < one.missed <= self.relief for one in both)
        return is_off and math.isclose(error.middle, at_lower_gain.middle, rel_tol=_SAME_MIDDLE)


def relative_error(signal: Array, setpoint: float | None, exponential: bool) -> Array:
    """Return the deviation of the signal from the setpoint, divided by the setpoint.

    Args:
        signal: the signal that the feedback holds at the setpoint, such as the amplitude; NaN where not measured.
        setpoint: the setpoint in the same unit; None: the signal's median, which is close to the setpoint unless
            the feedback is far off.
        exponential: whether the signal falls exponentially with the distance, as a tunnelling current of either sign
            does: then its logarithm is compared.

    Raises:
        InvalidValue: no value was measured, or the setpoint is zero.
    """
    there = signal[np.isfinite(signal)]
    if not there.size:
        raise InvalidValue("an error signal without a value")
    centre = float(np.median(there)) if setpoint is None else setpoint
    if centre == 0.0:
        raise InvalidValue("a setpoint of zero has no relative error")
    if exponential:
        return np.asarray(np.log(np.maximum(np.abs(signal / centre), _SMALLEST_CURRENT)))
    return np.asarray((signal - centre) / abs(centre))


def feedback_error(error: Array, threshold: float, height_m: Array | None = None, gap_m: float = 0.0) -> FeedbackError:
    """Return the measures of the error signal of one scan.

    A loop that lags leaves in the error the relief that is missing in the height. Compared in metres, this ratio is the
    same for every sample, speed and noise, since white noise has no correlation from pixel to pixel. A loop that
    oscillates moves height and error together; a lagging loop moves the height by the sum of the error. Without
    heights, with a gap of 0, or with too few complete rows, `missed` and `swing` are 0.

    Args:
        error: result of `relative_error`, [y, x].
        threshold: relative error above which a pixel counts in `over` or `under`.
        height_m: the heights of the same pixels; None if unknown.
        gap_m: excess height of the tip at a relative error of one, in m; 0 if unknown.
    """
    there = error[np.isfinite(error)]
    over, under = float(np.mean(there > threshold)), float(np.mean(there < -threshold))
    middle = float(np.median(there))
    if height_m is None or gap_m == 0.0:
        return FeedbackError(over, under, middle=middle)
    complete = np.isfinite(error).all(axis=1) & np.isfinite(height_m).all(axis=1)
    gap, height = error[complete] * gap_m, height_m[complete]
    if gap.shape[0] < 1 or gap.shape[1] < 4:
        return FeedbackError(over, under, middle=middle)
    missed = math.sqrt(_smooth_variance(gap) / max(_smooth_variance(height), np.finfo(float).tiny))
    moves, of_error = np.diff(height, axis=1), np.diff(gap, axis=1)
    swing = float((moves * of_error).sum() / max((of_error**2).sum(), np.finfo(float).tiny))
    return FeedbackError(over, under, missed, swing, middle)


def _smooth_variance(values: Array) -> float:
    # white noise has no covariance between neighbours, so theirs is the variance of the smooth part
    x = np.linspace(-1.0, 1.0, values.shape[1])
    level = values - values.mean(axis=1, keepdims=True)
    level = level - np.outer(level @ x / (x @ x), x)
    shared = float(np.mean(level[:, 1:] * level[:, :-1]))
    return shared if shared > _SIGNIFICANT * float(np.mean(level**2)) / math.sqrt(level.size) else 0.0


def gain_search(
    start: float, factor: float, lowest: float, highest: float, most_tries: int
) -> Generator[float, FeedbackQuality | None, float | None]:
    """Search for a gain at which the feedback follows well: higher while too slow, lower while oscillating.

    Yields gains to try, `start` first. The caller sends the quality at each gain, or None if the gain was refused: that
    gain, and any beyond it, is not tried again. The returned value is the gain to keep, or None if no gain was good.

    Args:
        start: within the bounds.
        factor: the factor of one step, above 1. Between a gain that is too low and a gain that is too high the steps
            get smaller.
        lowest, highest: bounds of the gain.
        most_tries: limit on the number of gains.
    """
    gain, slow, fast = start, 0.0, math.inf  # highest gain known too low, lowest known too high
    well = barely = None
    comes_from_above = is_bound = False
    for _ in range(most_tries):
        following = yield gain
        if following is None:
            # between an allowed gain and a refused one lies a bound that is not known: no step towards it
            fast, wanted, is_bound, comes_from_above = gain, gain / factor, True, False
        elif following is FeedbackQuality.OSCILLATES:
            fast, wanted, is_bound, comes_from_above = gain, gain / factor, False, well is None
        elif following is FeedbackQuality.TOO_SLOW:
            slow, wanted, comes_from_above = gain, gain * factor, False
        elif following is FeedbackQuality.BARELY:
            barely, wanted = gain, gain * factor
        elif comes_from_above:  # one step more, for a margin below the oscillation
            well, wanted, comes_from_above = gain, gain / factor, False
        else:
            return gain
        # three digits: a gain that the controller takes as a whole number stays one
        at, gain = gain, min(max(float(f"{wanted:.3g}"), lowest), highest)
        if gain == at or not slow < gain < fast:
            if well or barely or is_bound or not _CLOSE * slow < fast < math.inf or slow == 0.0:
                break
            gain = float(f"{math.sqrt(slow * fast):.3g}")
    return well or barely
