"""One pair, registered by some estimators, and the error of each."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.estimators import unguarded
from afspm.plugins.drift.registration import Registration
from benchmarks.drift import cuts
from benchmarks.drift.bounds import bounds
from benchmarks.drift.cuts import Cut
from benchmarks.drift.families import Half
from benchmarks.drift.pairs import PIXEL_M, Pair, Sampling, pair

FAILED_PX = 1.0  # further off than this is no estimate
PUBLISHED = "published brief"
BASELINES = {PUBLISHED: "benchmarks.drift.published.PublishedBrief"}  # by the names they have in tables
ELLIPSE_95 = 5.991  # of chi square with two degrees of freedom


@dataclass(frozen=True)
class Outcome:
    """The result of one estimator with one pair.

    Attributes:
        cell: the pair's group, as the part names it.
        error_px: (x, y) estimate minus truth at the middle of the overlap; NaN without an estimate or a truth.
        chi2: of the error and the covariance, both at the centre that the estimator chose.
        bound_px, white_bound_px: roots of the traces of Cb and C; NaN where the noise is not known.
        cpu_s: of this process.
        half: of the families; None: a standard pair of its surface and condition.
        quality: the estimator's figures of merit.
    """

    cell: str
    surface: str
    estimator: str
    seed: int
    accepted: bool
    reason: str
    error_px: tuple[float, float]
    chi2: float
    bound_px: float
    white_bound_px: float
    cpu_s: float
    half: Half | None = None
    quality: dict[str, float] = field(default_factory=dict)

    @property
    def off_px(self) -> float:
        return math.hypot(*self.error_px)

    @property
    def failed(self) -> bool:
        """No estimate, or an error of a pixel or more."""
        return not self.off_px <= FAILED_PX

    @property
    def wrong(self) -> bool:
        """Accepted, and wrong."""
        return self.accepted and self.failed


@dataclass(frozen=True)
class Trial:
    """A job: one pair, registered by some estimators."""

    cell: str
    surface: str
    condition: str
    seed: int
    estimators: tuple[str, ...]
    size: int = 128
    samplings: tuple[Sampling, Sampling] | None = None
    prior_sd_px: float | None = None
    half: Half | None = None

    def made(self) -> Pair | Cut:
        """Return the pair."""
        if self.half is not None and self.surface == cuts.SURFACE:
            return cuts.cut(self.condition, self.seed, self.half, self.prior_sd_px)
        return pair(
            self.surface, self.condition, self.seed, self.size, samplings=self.samplings,
            prior_sd_px=self.prior_sd_px, half=self.half,
        )  # fmt: skip

    def run(self) -> list[Outcome]:
        made = self.made()
        full = white = math.nan
        if isinstance(made, Pair) and made.truth is not None:
            best = bounds(made)
            full, white = math.sqrt(np.trace(best.full)), math.sqrt(np.trace(best.white))
        return [self._outcome(made, name, full, white) for name in self.estimators]

    def _outcome(self, made: Pair | Cut, name: str, bound_px: float, white_bound_px: float) -> Outcome:
        # unguarded: an error shows, and no plain correlation takes the place of the method that is measured
        register = unguarded(BASELINES.get(name, name)).register
        began_s = time.process_time()
        found = register(made.reference, made.scan, made.prior)
        cpu_s = time.process_time() - began_s
        error, chi2 = _errors(made, found)
        return Outcome(
            cell=self.cell,
            surface=self.surface,
            estimator=name,
            seed=self.seed,
            accepted=found.accepted,
            reason=found.reason,
            error_px=error,
            chi2=chi2,
            quality=dict(found.quality),
            bound_px=bound_px,
            white_bound_px=white_bound_px,
            cpu_s=cpu_s,
            half=self.half,
        )


def _errors(made: Pair | Cut, found: Registration) -> tuple[tuple[float, float], float]:
    # error at the middle of the overlap in pixels, and chi² at the centre of the estimate
    if made.truth is None or not np.isfinite(found.displacement_m).all():
        return (math.nan, math.nan), math.nan
    moved_m = found.displacement_m + found.linear @ (made.truth.center_m - found.center_m)
    x, y = (moved_m - made.truth.displacement_m) / PIXEL_M
    own = found.displacement_m - made.truth.at(found.center_m)
    try:
        chi2 = float(own @ np.linalg.solve(found.covariance_m2, own))
    except np.linalg.LinAlgError:
        chi2 = math.nan
    return (float(x), float(y)), chi2


@dataclass(frozen=True)
class Cell:
    """The figures of some outcomes.

    Attributes:
        rms_px, p95_px: of outcomes that did not fail.
        bound_px: root mean square of Cb over the same pairs.
        failed, accepted, wrong: shares of all.
        bias_px: mean error, (x, y), of outcomes that did not fail.
        covered: share of the accepted with the truth in their 95 % ellipse.
        right_accepted: share of accepted outcomes among the ones that did not fail.
        beyond_three: accepted ones with the truth outside of three times that ellipse.
        ms: median, of the processor's time.
    """

    count: int
    rms_px: float
    p95_px: float
    bound_px: float
    white_bound_px: float
    failed: float
    accepted: float
    wrong: float
    bias_px: tuple[float, float]
    covered: float
    ms: float
    right_accepted: float
    beyond_three: int

    @property
    def ratio(self) -> float:
        return self.rms_px / self.bound_px

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Cell:
        every = list(outcomes)
        good = [o for o in every if not o.failed]
        sure = [o for o in every if o.accepted]
        return cls(
            count=len(every),
            rms_px=_rms([o.off_px for o in good]),
            p95_px=_of([o.off_px for o in good], lambda a: float(np.percentile(a, 95))),
            bound_px=_rms([o.bound_px for o in good]),
            white_bound_px=_rms([o.white_bound_px for o in good]),
            failed=_of([o.failed for o in every]),
            accepted=_of([o.accepted for o in every]),
            wrong=_of([o.wrong for o in every]),
            bias_px=(_of([o.error_px[0] for o in good]), _of([o.error_px[1] for o in good])),
            covered=_of([o.chi2 <= ELLIPSE_95 for o in sure]),
            right_accepted=_of([o.accepted for o in good]),
            beyond_three=sum(not o.chi2 <= 9 * ELLIPSE_95 for o in sure if not math.isnan(o.off_px)),
            ms=1e3 * _of([o.cpu_s for o in every], lambda a: float(np.median(a))),
        )


def _mean(values: Array) -> float:
    return float(values.mean())


def _of(values: Sequence[float], figure: Callable[[Array], float] = _mean) -> float:
    # NaN without values
    return figure(np.array(values, dtype=np.float64)) if values else math.nan


def _rms(values: Sequence[float]) -> float:
    return _of(values, lambda a: math.sqrt(np.mean(a**2)))


def geometric_mean(values: Iterable[float]) -> float:
    """Return the geometric mean; NaN if any value is."""
    return float(np.exp(np.mean(np.log(np.array(list(values))))))
