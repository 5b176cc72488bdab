"""Registration of two scans: the interface of all estimators, and its result.

The modules hold the parts: search for the displacement and least squares over all pixels (`search`, `alignment`), or
features and the transform that most of them agree on (`keypoints`, `ransac`). `estimators` joins them with `doubt`.
"""

from __future__ import annotations

from collections.abc import Mapping as Table
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from afspm.components import Array
from afspm.model import RegistrationOutcome
from afspm.plugins.drift.pairs.drift_scan import DriftScan, Prior

__all__ = ["DriftScan", "Estimator", "LinearSeen", "Matches", "Prior", "Registration"]


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched features of two scans, for drawings. Positions (n, 2) are (x, y) in tip coordinates, m.

    Attributes:
        inlier: (n,) whether the estimate uses the pair.
    """

    reference_m: Array
    scan_m: Array
    inlier: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LinearSeen:
    """Linear part estimated without a prior, whereas a prior may bias `Registration.linear`.

    Attributes:
        linear: (2, 2) linear part.
        covariance: (4, 4) covariance of the elements, row by row.
    """

    linear: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class Registration:
    """Result of the registration of two scans: displacement, uncertainty and acceptance.

    A feature at `x` of the reference is found at `x + displacement_m + linear @ (x - center_m)` in the scan, both in
    tip coordinates.

    Attributes:
        accepted: whether the result may be used; if not, displacement and covariance are the best guess, or NaN.
        reason: reason for a refusal, for people; empty if accepted.
        displacement_m: (2,) displacement at `center_m`.
        covariance_m2: (2, 2) covariance of the displacement as the mean over the rows of the overlap during these two
            frames, not of the sample between two times: the mean wander of the lines over a frame counts as
            displacement. `track` adds the motion between the frames.
        linear: (2, 2) rotation, scale and shear; zero for a pure translation.
        center_m: (2,) centre of the overlap, where the displacement holds, in tip coordinates of the reference.
        quality: figures of merit by name (overlap, correlation, …), for people and for studies.
        matches: matched features, if the estimator uses features.
        linear_seen: linear part with its uncertainty, if the estimator provides it.
        failure: error of an estimator that raised or returned no usable result; empty without an error. A coarse
            estimate that replaces the failed result may be accepted; its linear part is unknown.
    """

    accepted: bool
    reason: str
    displacement_m: Array
    covariance_m2: Array
    linear: Array
    center_m: Array
    quality: Table[str, float] = field(default_factory=dict)
    matches: Matches | None = None
    linear_seen: LinearSeen | None = None
    failure: str = ""

    @classmethod
    def refused(cls, reason: str, quality: Table[str, float] | None = None) -> Registration:
        """Return a refusal without an estimate."""
        none, unknown = np.full(2, np.nan), np.full((2, 2), np.nan)
        return cls(
            accepted=False,
            reason=reason,
            displacement_m=none,
            covariance_m2=unknown,
            linear=np.zeros((2, 2)),
            center_m=none,
            quality=quality or {},
        )

    @classmethod
    def failed(cls, failure: str) -> Registration:
        """Return the result for an estimator that raised, or returned no usable result."""
        return replace(cls.refused(failure), failure=failure)

    @property
    def outcome(self) -> RegistrationOutcome:
        """Outcome for the position of the scan, judged by this pair alone."""
        if self.accepted:
            return RegistrationOutcome.COARSE if self.failure else RegistrationOutcome.REGISTERED
        return RegistrationOutcome.FAILED if self.failure else RegistrationOutcome.REFUSED

    @property
    def sd_m(self) -> float:
        """Standard deviation of the displacement along its most uncertain axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_m2)[-1]))


class Estimator(Protocol):
    """Stateless method to register two scans of the same channel."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """Return the displacement of the features of `reference` in `scan`.

        Must not raise because of the content of scans: pairs that can't be registered (no values, constant, no common
        features, ambiguous) are refused with a reason.
        """
        ...
