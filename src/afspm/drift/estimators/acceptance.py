"""Acceptance of a match: an estimate is always found, also where the scans show different places."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from afspm.errors import ConfigError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RINGS_PX = (9, 16)
PARTS = 8  # of the overlap in each direction
APART_PX = 4  # nearer than this a repetition is the match itself
FEW = 10  # with fewer repetitions a surface doesn't repeat itself


@dataclass(frozen=True)
class MatchEvidence:
    """Figures of merit of a match; see `AcceptanceLimits`."""

    overlap: float
    sd_px: float
    gap: float
    rival: float
    information: float
    agreement: float
    correlation: float
    correlation_gap: float
    edges_gap: float
    above_repeats: float
    outliers: float
    surprise: float


@dataclass(frozen=True)
class AcceptanceLimits:
    """The limits that a match must reach. Set by what true and wrong pairs of the benchmark reach.

    Attributes:
        overlap, overlap_expected: least part of the smaller scan; the latter where there is a prior.
        sd_px: largest standard deviation of the shift.
        gap: how much likelier, in nats, than any other shift.
        rival: likelihood of another shift, in nats, over that of the match, both compared with none. Where features of
            one kind are far apart, one may fit another as well as itself, and only shows less: the match may then be
            the wrong one. A surface that repeats itself has many such, and `gap` and what is asked of it besides count.
        information: mutual information of the aligned scans, nats.
        agreement: share of the parts of the overlap with features that correlate.
        correlation: mean over the parts, by their features.
        edges_gap: above the best correlation at 32 shifts about the match (surrogates), which a wrong match does no
            better than, in a band that favours edges.
        distinct: with this much of it the place is a place of its own. With less, the surface repeats itself, and more
            is asked for:
        correlation_gap: like `edges_gap`, of the scans as they are;
        above_repeats: standard deviations by which the match exceeds the sites about it that look the same. A prior
            singles out one site, whether or not it is the right one. A wrong one is one of many, and as far from their
            mean as chance has it (three, of some seventy); the right one alone has its defects in their places. Not
            asked where nothing is left to differ, the correlation being `alike`.
        outliers: largest variance of the residual over what is typical of it: of features that one scan alone has. In a
            lattice, defects are all that tells one place from another. Not asked where scans are `alike`, either.
        surprise: largest chi² of the shift, given the prior.
    """

    overlap: float = 0.4
    overlap_expected: float = 0.2
    sd_px: float = 0.3
    gap: float = 1.0
    rival: float = 0.65
    information: float = 60.0
    agreement: float = 0.7
    correlation: float = 0.6
    edges_gap: float = 0.0
    distinct: float = 0.3
    correlation_gap: float = 0.02
    above_repeats: float = 5.0
    outliers: float = 2.5
    alike: float = 0.985
    surprise: float = 14.0

    @classmethod
    def of(cls, table: Mapping[str, float]) -> AcceptanceLimits:
        """The usual limits but for what a table says.

        Raises:
            ConfigError: it names none of them, or gives no number.
        """
        known = [field.name for field in fields(cls)]
        for name, value in table.items():
            if name not in known:
                raise ConfigError(f"there is no limit {name!r}", where="limits", hint=f"known: {', '.join(known)}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ConfigError(f"{name} = {value!r} is not a number", where="limits")
        return cls(**table)

    def refusal(self, found: MatchEvidence, *, expected: bool) -> str:
        """Return why a match is refused, in words; empty if it is accepted."""
        overlap = self.overlap_expected if expected else self.overlap
        if found.correlation < self.correlation or found.information < self.information:
            return f"no common features (correlation {found.correlation:.2f}, {found.information:.0f} nats in common)"
        if found.overlap < overlap:
            return f"the scans overlap by {found.overlap:.0%} only, {overlap:.0%} are needed"
        if found.agreement < self.agreement:
            return f"only {found.agreement:.0%} of the parts with features agree, {self.agreement:.0%} are needed"
        repeats = found.edges_gap < self.distinct
        if found.gap < self.gap or (found.rival > self.rival and not repeats):
            return f"ambiguous: another displacement is almost as likely ({found.gap:.1f} nats less)"
        if found.edges_gap < self.edges_gap or (repeats and found.correlation_gap < self.correlation_gap):
            return "other displacements correlate as well"
        differ = found.correlation < self.alike
        if differ and found.above_repeats < self.above_repeats:
            return f"the surface repeats itself: a site like the others ({found.above_repeats:.1f} standard deviations)"
        if differ and repeats and found.outliers > self.outliers:
            return f"the surface repeats itself, and features differ ({found.outliers:.1f} times the typical residual)"
        if found.surprise > self.surprise:
            return f"far from what was expected (chi² {found.surprise:.0f})"
        if not found.sd_px < self.sd_px:
            return f"too uncertain: {found.sd_px:.2f} px"
        return ""


def agreement(one: Array, two: Array, known: Mask) -> tuple[float, float]:
    """Of 8 x 8 parts of two aligned images: the share of those with features (twice the power of what a typical part
    has left) that correlate by more than 0.5; and the correlation within the parts, each by its power."""
    n = np.maximum(_sums(known.astype(np.float64)), 1.0)
    a, b = _sums(one * known) / n, _sums(two * known) / n
    aa, bb, ab = (
        _sums(u * v * known) / n - p * q for u, v, p, q in ((one, one, a, a), (two, two, b, b), (one, two, a, b))
    )
    features = np.maximum(aa, bb) > 2.0 * np.median(aa + bb - 2.0 * ab)
    size = np.sqrt(np.maximum(aa, 0.0) * np.maximum(bb, 0.0))
    share = float(np.mean(ab[features] > 0.5 * size[features])) if features.any() else 0.0
    return share, float(ab.sum() / max(size.sum(), 1e-300))


def _sums(values: Array) -> Array:
    """Over each part."""
    for axis in (0, 1):
        values = np.add.reduceat(values, np.arange(PARTS) * values.shape[axis] // PARTS, axis=axis)
    return values


def outliers(residual: Array) -> float:
    """Variance of values over the square of their median absolute deviation; 1 for normal noise."""
    typical = 1.4826 * float(np.median(np.abs(residual)))
    return float(np.mean(residual**2)) / max(typical**2, 1e-300)


def above_surrogates(found: Array, origin: Array) -> float:
    """By how much the correlation of two aligned images, [y, x] with no shift at the origin, exceeds the best of those
    at 32 shifts on two rings."""
    cy, cx = origin
    angles = 2.0 * np.pi * np.arange(16) / 16
    y, x = (np.rint(np.outer(RINGS_PX, f(angles))).astype(int).ravel() for f in (np.sin, np.cos))
    inside = (np.abs(y) <= cy) & (np.abs(x) <= cx)
    return float(found[cy, cx] - found[y[inside] + cy, x[inside] + cx].max())


def above_repeats(found: Array, overlap: Array, origin: Array) -> float:
    """The same as a number of standard deviations of the shifts at which the surface repeats itself, about their mean:
    of the peaks at least half as high, where at least half as much overlaps. Coefficients are compared as Fisher does,
    by atanh. Infinite if there are next to no such peaks."""
    from scipy.ndimage import maximum_filter

    cy, cx = origin
    y, x = np.ogrid[: found.shape[0], : found.shape[1]]
    peak = (found == maximum_filter(found, 3)) & (found > found[cy, cx] / 2) & (overlap >= overlap[cy, cx] / 2)
    repeats = np.arctanh(found[peak & (np.hypot(y - cy, x - cx) >= APART_PX)])
    if repeats.size < FEW:
        return math.inf
    return float((np.arctanh(found[cy, cx]) - repeats.mean()) / max(float(repeats.std()), 1e-12))
