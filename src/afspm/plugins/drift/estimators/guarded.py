"""Guard around any estimator: distinguishes errors from refusals, reports errors, and replaces failed results.

A refusal means that two scans can't be registered. An error of the estimator says nothing about the scans, and
is reported with the pair. A plain correlation then replaces the result, if there is a prior and the peak is clear.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from afspm.plugins.drift.doubt.plausibility import unlike_drift
from afspm.plugins.drift.estimators.correlation import Correlation
from afspm.plugins.drift.pairs.overlap import overlap_ratio
from afspm.plugins.drift.registration import DriftScan, Estimator, LinearSeen, Prior, Registration

COARSE_SD_PX = 0.5
"""Standard deviation added in quadrature to the coarse estimate, in the larger pixel of both scans. The 95 % ellipses
then contain at least 98 % of the accepted pairs of the families, and of zooms in their survey."""

_log = logging.getLogger("afspm.plugins.drift")


@dataclass(frozen=True)
class PairFailure:
    """An error of an estimator with a pair of scans.

    Attributes:
        estimator: name of the estimator.
        reference, scan: the keys of both scans.
        reason: text of the exception, or the defect of the result.
    """

    estimator: str
    reference: str
    scan: str
    reason: str

    def __str__(self) -> str:
        pair = f"{_file(self.scan)} with {_file(self.reference)}"
        return f"{self.estimator} failed to register {pair}: {self.reason}: an error of the estimator, not of the scans"


def _file(key: str) -> str:
    return re.split(r"[\\/]", key)[-1] or "a scan"


Report = Callable[[PairFailure], None]


def log_failure(failure: PairFailure) -> None:
    _log.error("%s", failure)


class Guarded:
    """Guard that runs an estimator and validates its result.

    An exception, a result of the wrong type or shape, an accepted result with invalid numbers, or a refusal without a
    reason is a failure: see `Registration.failure`. A displacement without overlap, and a mirrored or much stretched
    sample, are refused. The estimator receives copies of the values, so that its changes do not reach later
    comparisons.

    Args:
        report: function called with each failure.
    """

    def __init__(self, inner: Estimator, name: str, report: Report = log_failure) -> None:
        self.inner = inner
        self.name = name
        self._report = report

    def __repr__(self) -> str:
        return f"<estimator {self.name}: {self.inner!r}>"

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        try:
            found = self.inner.register(_copied(reference), _copied(scan), prior)
            failure = _malformed(found)
        except Exception as error:  # an estimator may be a user's own code, and raise anything
            failure = f"{type(error).__name__}: {error}"
        if failure:
            self._report(PairFailure(self.name, reference.key, scan.key, failure))
            return self._coarse(reference, scan, prior, f"{self.name} failed: {failure}")
        impossible = _impossible(found, reference, scan)
        return Registration.refused(f"{self.name}: {impossible}") if impossible else found

    def _coarse(self, reference: DriftScan, scan: DriftScan, prior: Prior | None, failure: str) -> Registration:
        # without a prior a plain correlation takes one particle for another, with a clear peak
        if prior is None or isinstance(self.inner, Correlation):
            return Registration.failed(failure)
        try:
            found = Correlation().register(reference, scan, prior)
        except Exception as error:  # the same values may make this estimator raise, too
            self._report(PairFailure("correlation", reference.key, scan.key, f"{type(error).__name__}: {error}"))
            return Registration.failed(failure)
        if not found.accepted or _malformed(found) or _impossible(found, reference, scan):
            return Registration.failed(failure)
        wide_m = COARSE_SD_PX * max(*reference.pixel_m, *scan.pixel_m)
        return replace(found, covariance_m2=found.covariance_m2 + wide_m**2 * np.eye(2), failure=failure)


def _copied(scan: DriftScan) -> DriftScan:
    return replace(scan, values=np.array(scan.values, dtype=np.float64))


def _malformed(found: object) -> str:
    if not isinstance(found, Registration):
        return f"its result is a {type(found).__name__} instead of a Registration"
    arrays = {
        "displacement_m": (found.displacement_m, (2,)),
        "covariance_m2": (found.covariance_m2, (2, 2)),
        "linear": (found.linear, (2, 2)),
        "center_m": (found.center_m, (2,)),
    }
    for name, (value, shape) in arrays.items():
        if not (isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.shape == shape):
            return f"{name} is not an array of floats of shape {shape}: {value!r}"
        if found.accepted and not np.isfinite(value).all():
            return f"accepted with {name} = {value.tolist()}"
    if not found.accepted:
        return "" if found.reason else "refused without a reason"
    covariance = found.covariance_m2
    largest = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-6 * largest or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        return f"accepted with an invalid covariance: {covariance.tolist()}"
    return _malformed_linear(found.linear_seen)


def _malformed_linear(seen: object) -> str:
    if seen is None:
        return ""
    if not isinstance(seen, LinearSeen):
        return f"linear_seen is a {type(seen).__name__} instead of a LinearSeen"
    linear, covariance = np.asarray(seen.linear), np.asarray(seen.covariance)
    if (linear.shape, covariance.shape) != ((2, 2), (4, 4)) or not (
        np.isfinite(linear).all() and np.isfinite(covariance).all()
    ):
        return "linear_seen has no finite matrices of shapes (2, 2) and (4, 4)"
    if np.linalg.eigvalsh((covariance + covariance.T) / 2)[0] < 0.0:
        return f"linear_seen has an invalid covariance: {covariance.tolist()}"
    return ""


def _impossible(found: Registration, reference: DriftScan, scan: DriftScan) -> str:
    if not found.accepted:
        return ""
    seen = found.linear if found.linear_seen is None else np.asarray(found.linear_seen.linear)
    if unlike := unlike_drift(np.eye(2) + found.linear) or unlike_drift(np.eye(2) + seen):
        return f"accepted with a sample {unlike}"
    if overlap_ratio(reference.region, scan.region, found.displacement_m) == 0.0:
        far_m = float(np.hypot(*found.displacement_m))
        return f"accepted with a displacement of {far_m * 1e9:.3g} nm, at which the scans do not overlap"
    return ""
