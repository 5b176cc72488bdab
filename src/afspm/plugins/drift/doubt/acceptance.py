"""Acceptance of a match, since even scans of different places have a best match.

A logistic regression turns the evidence into the probability that the match is wrong by more than a pixel. The
coefficients are fitted by `python -m benchmarks.drift.fit`. It replaced thirteen limits in sequence, set on one
benchmark, which refused half of the right matches on other surfaces. Mutual information, the correlation of edges and
of parts, and outliers of the residual added nothing to the figures below.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.plugins.drift.doubt.coefficients import INTERCEPT, RIGHT, WEIGHTS
from afspm.plugins.drift.pairs.warp import derivative
from afspm.plugins.drift.registration.search import REPEATS

Mask = NDArray[np.bool_]

PARTS = 8  # largest number of parts of the overlap in each direction
PART_PX = 4  # smaller parts hold too little to correlate
APART_PX = 4  # a nearer peak is the match itself
FEW = 10  # with fewer repetitions a surface does not count as periodic
MOST_REPEATS = 30.0  # standard deviations, from which a match counts as unique
GROUND = 4.0  # times the gradient power of the residual, below which a place shows no feature
GROUND_PX = (1.5, 6.0)  # the band of the texture, standard deviations of Gaussians
LEAST_GROUND_PX = 300  # less area shows no texture
WRONG_AT_MOST = 0.05
"""Largest accepted probability that a match is wrong. A choice, not fitted: wrong matches among the accepted are too
few for a fit. In the families, where a third of the pairs are unrelated, 0.6 % of the accepted are wrong at this value,
nearly all of them stampers without a prior."""

RIVAL_AT_MOST = REPEATS
"""Largest accepted `rival` in a search of more than `NARROW` of the scan: a surface that repeats itself.

On a grating or a lattice a match one period away differs by a few grains or defects. With a distortion of its own for
each candidate (`Scorer.best`) the best one of 48 still and relaxing gratings was always right; but there is a best one
on another place of the grating, too, where rivals explain 0.71 and more. On surfaces that do not repeat, 1 of 1000
accepted matches has such a rival."""
LEAST_TEXTURE, WITHOUT_TEXTURE = 1.0, 0.1
"""Least `texture` of a match that was not expected, and the share of the allowed probability that holds below it.

Bars of a stamper have one shape and stand on a grid: two of them fit two others within the noise, 50 to 500 nats above
any other displacement. All three accepted ones of 60 unrelated pairs had a texture of -0.6 to 0.6. Of 203 right pairs
of all surfaces 3 have so little, and a probability above the tenth; on most, ground without features is nowhere."""
NARROW = 0.1  # a smaller searched share of the scan holds no match one period away, or the fitted evidence knows of it


@dataclass(frozen=True)
class MatchEvidence:
    """Figures of merit of a match.

    Attributes:
        overlap: area of the overlap, as share of the smaller scan.
        sd_px: largest standard deviation of the shift.
        gap: log-likelihood of the match minus the highest log-likelihood of any other shift, in nats.
        rival: log-likelihood of the best other shift over the log-likelihood of the match, both relative to no match.
            If equal features lie far apart, a match of two different features may fit as well, with less overlap.
        agreement: share of the featured parts of the overlap in which both scans correlate.
        above_repeats: standard deviations between the match and similar-looking sites around it. A prior selects one
            site, right or wrong. A wrong site is one of many, at a random distance from their mean; only the right one
            has its defects in their places.
        texture: agreement of the ground between features, in standard deviations; infinite without such ground. Bumps
            of one shape fit each other anywhere, and the ground between them shows the place. Not computed,
            and infinite, if `searched` is at most `NARROW`.
        surprise: chi² of the shift, given the prior.
        searched: share of the scan's area in which the prior allows the match; 1 without a prior. In a smaller area
            fewer sites fit by chance.
    """

    overlap: float
    sd_px: float
    gap: float
    rival: float
    agreement: float
    above_repeats: float
    texture: float
    surprise: float
    searched: float

    def features(self) -> dict[str, float]:
        """Return the figures of merit on the scales of the regression, limited to the range of real matches."""
        return {
            "overlap": math.log(max(self.overlap, 0.05)),
            "sd_px": math.log(min(max(self.sd_px, 1e-3), 10.0)),
            "gap": math.log1p(max(self.gap, 0.0)),
            "rival": -math.log(min(max(1.0 - self.rival, 0.01), 2.0)),
            "agreement": self.agreement,
            "above_repeats": math.log(min(max(self.above_repeats, 1.0), MOST_REPEATS)),
            "surprise": math.log1p(min(max(self.surprise, 0.0), 100.0)),
            "searched": math.log(min(max(self.searched, 1e-4), 1.0)),
        }

    def objections(self) -> dict[str, float]:
        """Return each figure's contribution to the log odds of a wrong match, relative to the median right match."""
        return {name: WEIGHTS[name] * (value - RIGHT[name]) for name, value in self.features().items()}

    @property
    def wrong(self) -> float:
        """Probability that the shift is wrong by more than a pixel."""
        odds = INTERCEPT + sum(self.objections().values())
        return 1.0 / (1.0 + math.exp(min(-odds, 700.0)))

    def refusal(self, wrong_at_most: float) -> str:
        """Return the reason for refusing the match, for people; empty for an accepted match."""
        if self.rival > RIVAL_AT_MOST and self.searched > NARROW:
            return f"the surface repeats itself: {self._why('rival')}; an expected displacement would decide"
        if self.wrong <= wrong_at_most:
            bare = self.texture < LEAST_TEXTURE and self.searched > NARROW
            if bare and self.wrong > WITHOUT_TEXTURE * wrong_at_most:
                return f"{self._why('texture')}; an expected displacement would decide"
            return ""
        objections = self.objections()
        why = self._why(max(objections, key=lambda name: objections[name]))
        return f"{why}; wrong with a probability of {self.wrong:.0%}, {wrong_at_most:.0%} is the most"

    def _why(self, name: str) -> str:
        return _REASONS[name].format(**asdict(self))


_REASONS = {
    "overlap": "the scans overlap by {overlap:.0%} only",
    "sd_px": "too uncertain: {sd_px:.2f} px",
    "gap": "ambiguous: another displacement is almost as likely ({gap:.1f} nats less)",
    "rival": "ambiguous: another displacement explains {rival:.0%} as much",
    "agreement": "no common features: {agreement:.0%} of the parts with features agree",
    "above_repeats": "the surface repeats itself: a site like the others ({above_repeats:.1f} standard deviations)",
    "texture": "the ground between the features shows nothing in common ({texture:.1f} standard deviations)",
    "surprise": "far from what was expected (chi² {surprise:.0f})",
    "searched": "one of many places at which a match could be",
}


def agreement(one: Array, two: Array, known: Mask) -> float:
    """Return the share of parts with features in which two aligned images correlate by more than 0.5.

    The overlap is divided into up to 8 x 8 parts. A part has features if its power is twice the residual power of a
    typical part.
    """
    n = np.maximum(_sums(known.astype(np.float64)), 1.0)
    a, b = _sums(one * known) / n, _sums(two * known) / n
    aa, bb, ab = (
        _sums(u * v * known) / n - p * q for u, v, p, q in ((one, one, a, a), (two, two, b, b), (one, two, a, b))
    )
    features = np.maximum(aa, bb) > 2.0 * np.median(aa + bb - 2.0 * ab)
    size = np.sqrt(np.maximum(aa, 0.0) * np.maximum(bb, 0.0))
    return float(np.mean(ab[features] > 0.5 * size[features])) if features.any() else 0.0


def _sums(values: Array) -> Array:
    for axis in (0, 1):
        parts = min(max(values.shape[axis] // PART_PX, 2), PARTS)
        values = np.add.reduceat(values, np.arange(parts) * values.shape[axis] // parts, axis=axis)
    return values


def above_repeats(found: Array, overlap: Array, origin: Array) -> float:
    """Return the height of a match above the repeats of a periodic surface, in standard deviations.

    Repeats are the peaks at least half as high as the match, with at least half the overlap. Coefficients are compared
    by Fisher's atanh. Infinite with fewer than 10 repeats, since the surface then does not count as periodic.

    Args:
        found: the correlation of two aligned images, [y, x], with zero shift at `origin`.
    """
    from scipy.ndimage import maximum_filter

    cy, cx = origin
    y, x = np.ogrid[: found.shape[0], : found.shape[1]]
    peak = (found == maximum_filter(found, 3)) & (found > found[cy, cx] / 2) & (overlap >= overlap[cy, cx] / 2)
    repeats = np.arctanh(found[peak & (np.hypot(y - cy, x - cx) >= APART_PX)])
    if repeats.size < FEW:
        return math.inf
    return float((np.arctanh(found[cy, cx]) - repeats.mean()) / max(float(repeats.std()), 1e-12))


def texture(one: Array, two: Array, known: Mask) -> float:
    """Return the correlation of two aligned images, in standard deviations, on the ground between their features.

    Ground is where the mean is not much steeper than the residual. Infinite with too little ground: features or a
    texture above the noise are everywhere, and they agree.

    Args:
        one, two: images smoothed by a Gaussian of 1 px, without lines.
    """
    from scipy.ndimage import binary_erosion, gaussian_filter

    fine, coarse = (math.sqrt(width**2 - 1.0) for width in GROUND_PX)

    def steepness(values: Array) -> Array:
        smooth = gaussian_filter(values, fine)
        slopes: Array = gaussian_filter(derivative(smooth, 0) ** 2 + derivative(smooth, 1) ** 2, 3.0)
        return slopes

    ground = known & (steepness((one + two) / 2) < GROUND * np.median(steepness((two - one) / 2)))
    ground = binary_erosion(ground, iterations=2, border_value=1)
    inner = binary_erosion(ground, iterations=2, border_value=1)
    if np.count_nonzero(inner) < LEAST_GROUND_PX:
        return math.inf

    weights = [np.maximum(gaussian_filter(ground * 1.0, width), 1e-3) for width in (fine, coarse)]

    def band(values: Array) -> Array:
        near, far = (
            gaussian_filter(values * ground, width) / weight
            for width, weight in zip((fine, coarse), weights, strict=True)
        )
        within = (near - far)[inner]
        return np.asarray(within - within.mean())

    a, b = band(one), band(two)
    independent = a.size / (4.0 * math.pi * GROUND_PX[0] ** 2)
    correlation = min(float(a @ b) / max(math.sqrt((a @ a) * (b @ b)), 1e-300), 0.9999)
    return math.atanh(correlation) * math.sqrt(independent)
