"""Is the tip still what it was? Scans against a reference that was learnt from the first ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from afspm.components.tip_metrics import (
    LEAST_CONTRAST,
    Array,
    TipMetrics,
    autocorrelation,
    ghost,
    metrics,
    slopes,
)
from afspm.errors import ConfigError, InvalidValue

REACH_PX = 32  # how far beside the first the second apex of a double tip is looked for
MAD_TO_SIGMA = 1.4826  # of normally distributed values
SAME_PIXEL = 0.02  # relative difference of pixel sizes that are still called the same


class Opinion(Enum):
    """What is thought of the tip after a scan."""

    LEARNING = "learning"
    GOOD = "good"
    BAD = "bad"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Verdict:
    """The opinion on one scan, and why, for a person."""

    opinion: Opinion
    why: str
    metrics: TipMetrics | None = None


@dataclass(frozen=True)
class Tolerance:
    """How far a tip may be from the reference and still be called good.

    Attributes:
        detail: the share of the reference's fine detail that is left.
        ghost: correlation of a ghost image beyond the reference's.
        unrest: factor on the reference's disagreement of trace and retrace.
        sigmas: a scan is bad only if it is so many standard deviations of the reference away, too.
        margin: a scan within this share of the way to a limit is good; between it and the limit it is unclear,
            so that a tip at the limit does not go back and forth.
    """

    detail: float = 0.6
    ghost: float = 0.12
    unrest: float = 3.0
    sigmas: float = 5.0
    margin: float = 0.85

    def __post_init__(self) -> None:
        if not (0 < self.detail < 1 and 0 < self.ghost < 1 and self.unrest > 1 and self.sigmas >= 0):
            raise ConfigError(
                f"these tolerances make no sense: {asdict(self)}", hint="0 < detail, ghost < 1; unrest > 1; sigmas >= 0"
            )
        if not 0 < self.margin <= 1:
            raise ConfigError(f"margin {self.margin} is not between 0 and 1")


@dataclass
class Reference:
    """What the scans of a good tip are like. They must be taken with the same pixel size and shape.

    Attributes:
        pixel_m: (x, y).
        shape: (rows, columns).
        learnt: the metrics of the scans so far; their ghosts are against what was expected then.
        expected: the mean autocorrelation of the slopes.
    """

    pixel_m: tuple[float, float]
    shape: tuple[int, int]
    learnt: list[TipMetrics] = field(default_factory=list)
    expected: Array | None = None

    def fits(self, pixel_m: tuple[float, float], shape: tuple[int, int]) -> bool:
        """Whether a scan can be compared."""
        close = all(abs(a / b - 1.0) < SAME_PIXEL for a, b in zip(pixel_m, self.pixel_m, strict=True))
        return close and tuple(shape) == tuple(self.shape)

    def learn(self, seen: TipMetrics, correlation: Array) -> None:
        """One more scan of a good tip."""
        count = len(self.learnt)
        before = np.zeros_like(correlation) if self.expected is None else self.expected
        self.expected = (before * count + correlation) / (count + 1)
        self.learnt.append(seen)

    def centre_and_spread(self, name: str) -> tuple[float, float]:
        """Median, and the standard deviation estimated by the median of deviations."""
        values = np.array([getattr(seen, name) for seen in self.learnt])
        centre = float(np.median(values))
        return centre, MAD_TO_SIGMA * float(np.median(np.abs(values - centre)))

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {
            "pixel_m": list(self.pixel_m),
            "shape": list(self.shape),
            "learnt": [seen.to_dict() for seen in self.learnt],
            "expected": None if self.expected is None else np.round(self.expected, 4).tolist(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Reference:
        x, y = values["pixel_m"]
        rows, columns = values["shape"]
        expected = values["expected"]
        learnt = [TipMetrics.from_dict(seen) for seen in values["learnt"]]
        return cls((x, y), (rows, columns), learnt, None if expected is None else np.asarray(expected))


class TipJudge:
    """Learns from the first scans, then judges.

    Args:
        reference_scans: how many are learnt from. The tip has to be good by then: nobody can tell from inside.
        tolerance: see there.
        reference: what was learnt in an earlier life.
    """

    def __init__(self, reference_scans: int, tolerance: Tolerance, reference: Reference | None = None) -> None:
        if reference_scans < 2:
            raise ConfigError(f"{reference_scans} reference scans have no spread", hint="2 at least", where="tip")
        self.reference_scans = reference_scans
        self.tolerance = tolerance
        self.reference = reference

    @property
    def has_learnt(self) -> bool:
        return self.reference is not None and len(self.reference.learnt) >= self.reference_scans

    def judge(self, trace: Array, retrace: Array | None, pixel_m: tuple[float, float]) -> Verdict:
        """What a scan tells of the tip.

        Args:
            trace, retrace: heights in m, [y, x]; retrace None where it is not recorded.
            pixel_m: distance of pixels (x, y).
        """
        shape = (trace.shape[0], trace.shape[1])
        if self.reference is not None and not self.reference.fits(pixel_m, shape):
            return Verdict(Opinion.UNCLEAR, "taken with another pixel size than the reference")
        try:
            seen_slopes = slopes(trace, retrace)
        except InvalidValue as error:
            return Verdict(Opinion.UNCLEAR, error.what)
        correlation = autocorrelation(seen_slopes, min(REACH_PX, min(shape) // 3))
        seen = metrics(seen_slopes, correlation, self.reference.expected if self.reference else None)
        if seen.contrast < LEAST_CONTRAST:
            # an empty terrace shows no tip; a tip that fell off shows no terrace, but unrest
            return Verdict(Opinion.UNCLEAR, f"nothing to see but noise (contrast {seen.contrast:.1f})", seen)
        if not self.has_learnt:
            return self._learn(seen, correlation, pixel_m, shape)
        return self._compare(seen)

    def _learn(
        self, seen: TipMetrics, correlation: Array, pixel_m: tuple[float, float], shape: tuple[int, int]
    ) -> Verdict:
        if self.reference is None:
            self.reference = Reference(pixel_m, shape)
            # of the first scan nothing is expected: its ghost would be the sample's own order
            seen = TipMetrics(seen.detail, ghost(correlation, correlation), seen.unrest_m, seen.contrast)
        self.reference.learn(seen, correlation)
        return Verdict(Opinion.LEARNING, f"reference {len(self.reference.learnt)} of {self.reference_scans}", seen)

    def _compare(self, seen: TipMetrics) -> Verdict:
        faults = [fault for fault in (self._detail(seen), self._ghost(seen), self._unrest(seen)) if fault is not None]
        bad = [why for way, why in faults if way >= 1.0]
        doubtful = [why for way, why in faults if self.tolerance.margin < way < 1.0]
        if bad:
            return Verdict(Opinion.BAD, "; ".join(bad), seen)
        if doubtful:
            return Verdict(Opinion.UNCLEAR, "nearly " + "; ".join(doubtful), seen)
        return Verdict(Opinion.GOOD, _summary(seen, self._reference()), seen)

    def _reference(self) -> Reference:
        if self.reference is None:
            raise InvalidValue("nothing was learnt yet")
        return self.reference

    def _detail(self, seen: TipMetrics) -> tuple[float, str]:
        centre, spread = self._reference().centre_and_spread("detail")
        limit = max(min(centre * self.tolerance.detail, centre - self.tolerance.sigmas * spread), 0.1 * centre)
        way = (centre - seen.detail) / (centre - limit) if centre > limit else 0.0
        return way, f"blunt: {_share(seen.detail, centre)} of the reference's fine detail is left"

    def _ghost(self, seen: TipMetrics) -> tuple[float, str]:
        centre, spread = self._reference().centre_and_spread("ghost")
        limit = max(centre + self.tolerance.ghost, centre + self.tolerance.sigmas * spread)
        way = (seen.ghost - centre) / (limit - centre)
        return way, f"double: a ghost image with correlation {seen.ghost:.2f} (reference {centre:.2f})"

    def _unrest(self, seen: TipMetrics) -> tuple[float, str]:
        centre, spread = self._reference().centre_and_spread("unrest_m")
        if centre <= 0.0:  # no retrace is recorded
            return 0.0, ""
        limit = max(centre * self.tolerance.unrest, centre + self.tolerance.sigmas * spread)
        way = (seen.unrest_m - centre) / (limit - centre)
        what = f"{seen.unrest_m * 1e9:.2f} nm (reference {centre * 1e9:.2f} nm)"
        return way, f"unsteady: trace and retrace disagree by {what}"


class Counter:
    """Turns opinions into a flag: a number of bad ones in a row sets it, a number of good ones clears it."""

    def __init__(self, flag_after: int, clear_after: int, state: Sequence[int] = (0, 0)) -> None:
        if flag_after < 1 or clear_after < 1:
            raise ConfigError("it takes one scan at least to flag or to clear")
        self.flag_after, self.clear_after = flag_after, clear_after
        self.bad, self.good = state

    def count(self, opinion: Opinion) -> None:
        """Take in one more. What is unclear neither counts nor interrupts."""
        if opinion is Opinion.BAD:
            self.bad, self.good = self.bad + 1, 0
        elif opinion is Opinion.GOOD:
            self.bad, self.good = 0, self.good + 1

    @property
    def wants_flag(self) -> bool:
        return self.bad >= self.flag_after

    @property
    def wants_clear(self) -> bool:
        return self.good >= self.clear_after

    @property
    def state(self) -> list[int]:
        """JSON-able."""
        return [self.bad, self.good]


def _share(value: float, of: float) -> str:
    return f"{value / of:.0%}" if of > 0 else "nothing"


def _summary(seen: TipMetrics, reference: Reference) -> str:
    detail = _share(seen.detail, reference.centre_and_spread("detail")[0])
    return f"detail {detail}, ghost {seen.ghost:.2f}, unrest {seen.unrest_m * 1e9:.2f} nm"
