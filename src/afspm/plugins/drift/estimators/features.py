"""Registration by features, after the paper (supporting information, "Drift Estimation").

Keypoints, descriptors, brute-force matches with cross-check, and the transform that most matches agree on. Added to the
paper: a result is accepted only if its matches can't agree by chance (`evidence`); the fit is tightened, since a
threshold of 5 % of the scan lets mismatches in (`tighten`); pixels need not be square; the result has a covariance.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from afspm.basics import ConfigError
from afspm.components import Array
from afspm.plugins.drift.doubt.evidence import ConsensusEvidence, Standards, covariance_m2, weighed
from afspm.plugins.drift.pairs.images import CommonGrid, Image, Unusable, onto_common_grid, prepare
from afspm.plugins.drift.pairs.overlap import overlap_center_m
from afspm.plugins.drift.registration import DriftScan, Matches, Prior, Registration
from afspm.plugins.drift.registration.keypoints import KINDS, Keypoints, matched
from afspm.plugins.drift.registration.ransac import FORMS, Consensus, Form, Search, tightened

FINE_PX = 1.5  # largest usual distance of a right pair from the transform
GATE = 25.0  # chi² from the expectation, the limit of the search


@dataclass(frozen=True)
class Features:
    """Base class of the feature-based estimators `Brief`, `Orb` and `Sift`.

    Attributes:
        transform: "translation", "euclidean", "similarity" or "affine".
        residual_threshold: largest distance of a RANSAC inlier from the transform, as share of the scans' mean side.
        iterations: largest number of RANSAC iterations, each with a random minimal sample. A smaller share of right
            matches needs more iterations.
        tighten: whether to drop inliers that are farther off than most; the paper keeps them.
        max_keypoints: largest number of keypoints in each scan; the strongest are kept.
        false_alarms: largest accepted number of false alarms: the number of equally large consensuses expected by
            chance between two scans without common features.
        inlier_share: least share of inliers among all matches.
        ambiguity: largest accepted size of the second-best consensus, at another displacement, as share of the best.
        bend_max: largest deviation of an element of the transform's 2 x 2 matrix from the identity; limits rotation,
            scale and shear.
        seed: seed of the random samples; equal scans give equal results.

    Raises:
        ConfigError: an unknown transform, or a number out of its range.
    """

    transform: str = "translation"
    residual_threshold: float = 0.05
    iterations: int = 100
    tighten: bool = True
    max_keypoints: int = 2000
    false_alarms: float = 1e-3
    inlier_share: float = 0.12
    ambiguity: float = 0.3
    bend_max: float = 0.1
    seed: int = 0
    kind: ClassVar[str]
    requires: ClassVar = ("afspm[features]",)

    def __post_init__(self) -> None:
        if self.transform not in FORMS:
            near = difflib.get_close_matches(str(self.transform), FORMS, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(FORMS)}"
            raise ConfigError(f"no transform {self.transform!r}", where="transform", hint=hint)
        for name in ("residual_threshold", "false_alarms", "inlier_share", "ambiguity", "bend_max"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ConfigError(f"{getattr(self, name)!r} must be above 0 and at most 1", where=name)
        for name in ("iterations", "max_keypoints"):
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= 1):
                raise ConfigError(f"{getattr(self, name)!r} is not a number from 1", where=name)

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        images: list[Image] = []
        for name, one in (("reference", reference), ("scan", scan)):
            try:
                images.append(prepare(one.values))
            except Unusable as error:
                return Registration.refused(f"the {name}: {error}")
        grid, *images = onto_common_grid(reference, images[0], scan, images[1])
        pixel_m = float(np.linalg.norm(grid.to_m, axis=0).max())
        known = [KINDS[self.kind](image, self.max_keypoints) for image in images]
        a, b = _matched(grid, known[0], known[1], prior, slack_m=pixel_m + 0.01 * max(reference.region.size_m))
        quality = {"keypoints": float(min(map(len, known))), "matches": float(len(a))}
        found = self._consensus(a, b, self._limit_m(reference, scan), FINE_PX * pixel_m)
        if found is None:
            return Registration.refused(f"no transform agrees with any of {len(a)} matches", quality)
        return self._judged(reference, scan, ConsensusEvidence(a, b, found, self._form, pixel_m), prior, quality)

    @property
    def _form(self) -> Form:
        return FORMS[self.transform]

    def _limit_m(self, reference: DriftScan, scan: DriftScan) -> float:
        return self.residual_threshold * float(np.mean([reference.region.size_m, scan.region.size_m]))

    def _consensus(self, a: Array, b: Array, limit_m: float, fine_m: float) -> Consensus | None:
        search = Search(self._form, self.iterations, self.bend_max, np.random.default_rng(self.seed))
        best = search.among(a, b, limit_m)
        if best is None or not self.tighten:
            return best
        least = min(fine_m, limit_m) / 3
        return tightened(a, b, best, self._form, least=least, most=limit_m, bend_max=self.bend_max)

    def _judged(
        self,
        reference: DriftScan,
        scan: DriftScan,
        evidence: ConsensusEvidence,
        prior: Prior | None,
        quality: dict[str, float],
    ) -> Registration:
        transform = evidence.consensus.transform
        center = overlap_center_m(reference.region, scan.region, transform.shift)
        if center is None:
            return Registration.refused("the matches that agree lie outside the overlap of the scans", quality)
        displacement = transform.shift_at(center)
        standards = Standards(self.false_alarms, self.inlier_share, self.ambiguity, self.iterations, self.seed)
        covariance = covariance_m2(evidence, reference.region, scan.region, center)
        figures, reason = weighed(evidence, reference.region, scan.region, prior, standards, covariance, center)
        return Registration(
            accepted=not reason,
            reason=reason,
            displacement_m=displacement,
            covariance_m2=covariance,
            linear=transform.linear - np.eye(2),
            center_m=center,
            quality=quality | figures,
            matches=Matches(evidence.a, evidence.b, evidence.consensus.inlier),
        )


class Brief(Features):
    """Estimator with Harris corners and BRIEF descriptors, the paper's default. Not invariant to rotation."""

    kind = "brief"


class Orb(Features):
    """Estimator with ORB features, which are invariant to rotation."""

    kind = "orb"


class Sift(Features):
    """Estimator with SIFT features, which are invariant to rotation and scale."""

    kind = "sift"


def _matched(
    grid: CommonGrid, first: Keypoints, second: Keypoints, prior: Prior | None, *, slack_m: float
) -> tuple[Array, Array]:
    # with a prior only pairs that it allows are matched, plus `slack_m` for the error of a keypoint and a small turn
    a, b = first.xy_px @ grid.to_m.T + grid.reference_m, second.xy_px @ grid.to_m.T + grid.scan_m
    if prior is None:
        pairs = matched(first.descriptors, second.descriptors)
        return a[pairs[:, 0]], b[pairs[:, 1]]
    inverse = np.linalg.inv(prior.covariance_m2 + np.eye(2) * slack_m**2)

    def allowed(rows: slice) -> NDArray[np.bool_]:
        x, y = (b[None, :, axis] - a[rows, None, axis] - prior.mean_m[axis] for axis in (0, 1))
        near: NDArray[np.bool_] = inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y < GATE
        return near

    pairs = matched(first.descriptors, second.descriptors, allowed)
    return a[pairs[:, 0]], b[pairs[:, 1]]
