"""Around any estimator: whatever goes wrong in it is a refusal with the reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from afspm.drift.mapping import unlike_drift
from afspm.drift.overlap import overlap_ratio
from afspm.drift.registration import DriftScan, Estimator, LinearSeen, Prior, Registration


class Guarded:
    """Runs an estimator so that nobody else needs to be careful.

    An exception, a result that is none, of wrong shapes, or accepted with values that can't be, comes out as refused;
    so does a displacement with which the scans would share nothing, and a sample that is mirrored or much stretched.
    The estimator gets copies: what it does to them can't reach those who compare the same scans later.
    """

    def __init__(self, inner: Estimator, name: str) -> None:
        self.inner = inner
        self.name = name

    def __repr__(self) -> str:
        return f"<estimator {self.name}: {self.inner!r}>"

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        """See `Estimator`."""
        try:
            found = self.inner.register(_copied(reference), _copied(scan), prior)
        except Exception as error:  # anybody's code may stumble in any way
            return Registration.refused(f"{self.name} failed: {type(error).__name__}: {error}")
        wrong = _wrong(found) or _impossible(found, reference, scan)
        return Registration.refused(f"{self.name} failed: {wrong}") if wrong else found


def _copied(scan: DriftScan) -> DriftScan:
    return replace(scan, values=np.array(scan.values, dtype=np.float64))


def _wrong(found: object) -> str:
    """Return what makes a result unusable; empty for nothing."""
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
    return _wrong_linear(found.linear_seen)


def _wrong_linear(seen: object) -> str:
    """Return what makes a linear part with its covariance unusable; empty for nothing, and for None."""
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
    return unlike_drift(np.eye(2) + linear)


def _impossible(found: Registration, reference: DriftScan, scan: DriftScan) -> str:
    """Why an accepted result of the right form can't be true of any sample; empty if it can."""
    if not found.accepted:
        return ""
    if unlike := unlike_drift(np.eye(2) + found.linear):
        return f"accepted with a sample {unlike}"
    if overlap_ratio(reference.region, scan.region, found.displacement_m) == 0.0:
        far_m = float(np.hypot(*found.displacement_m))
        return f"accepted with a displacement of {far_m:.3g} m, at which the scans do not overlap"
    return ""
