"""Evidence of matched features: the probability of agreement by chance, and the uncertainty of the displacement.

A large number of agreeing matches excludes chance. A periodic surface is excluded if no other displacement has nearly
as many matches. Matches in several places exclude a single look-alike feature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.pairs.overlap import overlap_ratio
from afspm.plugins.drift.registration import Prior
from afspm.plugins.drift.registration.ransac import (
    FORMS,
    Consensus,
    Form,
    Search,
    jackknife_covariance,
    log10_false_alarms,
)

_RADIUS_PX = 1.5  # least radius of agreement for the chance and for rivals
_REACH_PX = 4.0  # matches nearer to each other count as the same feature
_BLOCKS = 4  # the reference is divided into 4 x 4 blocks
_BLOCKS_MIN = 4
_OVERLAP_MIN, _OVERLAP_MIN_WITH_PRIOR = 0.3, 0.2
_UNSEEN_PX = 0.1  # common error of the keypoints of both scans, which no scatter shows
_FEW_BLOCKS = 1.5  # factor on the covariance: a jackknife of few blocks has heavy tails
_DEVIATIONS_MAX = 25.0  # chi² from the prior, above which a result is refused


@dataclass(frozen=True, eq=False)
class ConsensusEvidence:
    """Matched features of two scans, and the consensus transform of the agreeing pairs.

    `a` and `b` are positions (n, 2) in tip coordinates, m; `pixel_m` is the common pixel size.
    """

    a: Array
    b: Array
    consensus: Consensus
    form: Form
    pixel_m: float

    @property
    def radius_m(self) -> float:
        """Radius of agreement in the estimates of chance and rivals, at least 1.5 pixels."""
        return max(self.consensus.radius, _RADIUS_PX * self.pixel_m)


@dataclass(frozen=True)
class Standards:
    """Thresholds for the evidence; see `Features`."""

    false_alarms: float
    inlier_share: float
    ambiguity: float
    iterations: int
    seed: int


def weighed(
    evidence: ConsensusEvidence,
    reference: Region,
    scan: Region,
    prior: Prior | None,
    standards: Standards,
    covariance: Array,
    center: Array,
) -> tuple[dict[str, float], str]:
    """Return figures of merit by name, and the reason for refusing the match (empty if accepted)."""
    inlier, transform = evidence.consensus.inlier, evidence.consensus.transform
    off = transform(evidence.a[inlier]) - evidence.b[inlier]
    figures = {
        "inliers": float(inlier.sum()),
        "share": float(inlier.mean()),
        "residual_px": float(np.sqrt((off**2).sum(axis=1).mean())) / evidence.pixel_m,
        "log10_false_alarms": _log10_false_alarms(evidence, reference, prior),
        "second": _second(evidence, standards),
        "blocks": float(len(np.unique(_blocks(evidence.a[inlier], reference)))),
        "overlap": overlap_ratio(reference, scan, transform.shift),
    }
    expected = None if prior is None else transform.shift_at(center) - prior.mean_m
    deviations = 0.0
    if prior is not None and expected is not None and np.isfinite(covariance).all():
        deviations = float(expected @ np.linalg.solve(prior.covariance_m2 + covariance, expected))
    return figures, _objection(figures, len(evidence.a), standards, prior is not None, covariance, deviations)


def covariance_m2(evidence: ConsensusEvidence, reference: Region, scan: Region, center: Array) -> Array:
    """Return the covariance (2, 2) of the displacement at `center`; NaN if the inliers lie in too few places."""
    inlier = evidence.consensus.inlier
    a, b = evidence.a[inlier], evidence.b[inlier]
    scatter = jackknife_covariance(a, b, _blocks(a, reference), evidence.form, center)
    if scatter is None:
        return np.full((2, 2), np.nan)
    return _FEW_BLOCKS * scatter + np.eye(2) * (_UNSEEN_PX * evidence.pixel_m) ** 2


def _objection(
    figures: dict[str, float], matches: int, standards: Standards, has_prior: bool, covariance: Array, deviations: float
) -> str:
    if figures["log10_false_alarms"] > math.log10(standards.false_alarms):
        return f"that {figures['inliers']:.0f} of {matches} matches agree may be chance"
    if figures["share"] < standards.inlier_share:
        return f"only {figures['inliers']:.0f} of {matches} matches agree"
    if figures["second"] > standards.ambiguity:
        return f"ambiguous: {figures['second']:.0%} as many matches agree on another displacement"
    if figures["blocks"] < _BLOCKS_MIN or not np.isfinite(covariance).all():
        return "the matches that agree all lie in one place"
    if figures["overlap"] < (_OVERLAP_MIN_WITH_PRIOR if has_prior else _OVERLAP_MIN):
        return f"the scans share only {figures['overlap']:.0%}"
    if deviations > _DEVIATIONS_MAX:
        return f"{math.sqrt(deviations):.1f} standard deviations from what was expected"
    return ""


def _log10_false_alarms(evidence: ConsensusEvidence, reference: Region, prior: Prior | None) -> float:
    # several matches of one feature are not independent, so only one match counts
    radius_m = evidence.radius_m
    # Two random places in the scans lie a given displacement apart with at most this density.
    area_m2 = reference.size_m[0] * reference.size_m[1]
    if prior is not None:
        reach_m2 = np.linalg.det(prior.covariance_m2 + np.eye(2) * (0.01 * max(reference.size_m)) ** 2)
        area_m2 = min(area_m2, math.pi * 25.0 * math.sqrt(float(reach_m2)))
    chance = min(math.pi * radius_m**2 / area_m2, 1.0)
    inlier, reach_m = evidence.consensus.inlier, _REACH_PX * evidence.pixel_m
    agree, others = (_places(evidence.a[which], reach_m) for which in (inlier, ~inlier))
    return log10_false_alarms(agree + others, agree, evidence.form.pairs, chance)


def _second(evidence: ConsensusEvidence, standards: Standards) -> float:
    transform, radius_m = evidence.consensus.transform, evidence.radius_m
    far = ((transform(evidence.a) - evidence.b) ** 2).sum(axis=1) > (2.0 * radius_m) ** 2
    search = Search(FORMS["translation"], standards.iterations, 1.0, np.random.default_rng(standards.seed))
    other = search.among(evidence.a[far], evidence.b[far], radius_m)
    return 0.0 if other is None or other.count < 2 else other.count / evidence.consensus.count


def _places(points: Array, reach_m: float) -> int:
    return len(np.unique(np.floor(points / reach_m).astype(np.int64), axis=0))


def _blocks(points: Array, reference: Region) -> NDArray[np.intp]:
    cos, sin = math.cos(reference.angle_rad), math.sin(reference.angle_rad)
    along = (points - np.array(reference.center_m)) @ np.array([[cos, -sin], [sin, cos]])
    number = np.floor((along / reference.size_m + 0.5) * _BLOCKS).astype(np.intp).clip(0, _BLOCKS - 1)
    blocks: NDArray[np.intp] = number[:, 1] * _BLOCKS + number[:, 0]
    return blocks
