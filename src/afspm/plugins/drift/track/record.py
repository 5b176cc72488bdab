"""Record of the drift in a run, scan by scan, as a CSV table; for runs and off-line analysis."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from afspm.basics import FileError
from afspm.components import Array
from afspm.model import RegistrationOutcome, registration_summary
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track.tracking import Update
from afspm.record import drift_at

COLUMNS = (
    "scan", "time_s", "center_x_m", "center_y_m", "drift_x_m", "drift_y_m", "var_x_m2", "var_y_m2", "cov_xy_m2",
    "rate_x_m_s", "rate_y_m_s", "matched", "reason", "outcome", "failures",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class DriftRecord:
    """Drift of n scans in order of time; positions are in tip coordinates.

    Attributes:
        keys: the name of each scan.
        time_s: (n,) middle of each scan.
        center_m: (n, 2) centre of each scan's region.
        drift_m: (n, 2) displacement of the sample under the tip since the start, as estimated after each scan.
        covariance_m2: (n, 2, 2) covariance of the drift.
        rate_m_s: (n, 2) velocity of the sample after each scan; zero after the first scan (unknown then).
        matched: (n,) whether each scan was registered; the drift of other scans is a prediction.
        reasons: reason why each scan was not registered, for people; empty for registered scans.
        outcomes: outcome of the registration of each scan.
        failures: number of estimator errors with each scan.
    """

    keys: tuple[str, ...]
    time_s: Array
    center_m: Array
    drift_m: Array
    covariance_m2: Array
    rate_m_s: Array
    matched: NDArray[np.bool_]
    reasons: tuple[str, ...]
    outcomes: tuple[RegistrationOutcome, ...]
    failures: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, part: slice) -> DriftRecord:
        return self.chosen(range(len(self.keys))[part])

    def chosen(self, which: Sequence[int]) -> DriftRecord:
        """Return the record of the scans with the given indices, in the given order."""
        at = list(which)
        return DriftRecord(
            tuple(self.keys[k] for k in at), self.time_s[at], self.center_m[at], self.drift_m[at],
            self.covariance_m2[at], self.rate_m_s[at], self.matched[at], tuple(self.reasons[k] for k in at),
            tuple(self.outcomes[k] for k in at), tuple(self.failures[k] for k in at),
        )  # fmt: skip

    def summary(self) -> str:
        """Return a text with the number of registered scans."""
        return registration_summary(self.outcomes)

    @property
    def sd_m(self) -> Array:
        """Standard deviations of the drift in x and y, (n, 2)."""
        return np.sqrt(np.diagonal(self.covariance_m2, axis1=1, axis2=2))

    @property
    def rate_then_m_s(self) -> Array:
        """Velocity during each scan, (n, 2); the unknown first velocity is replaced by the second."""
        rates = self.rate_m_s.copy()
        if len(rates) > 1 and not rates[0].any():
            rates[0] = rates[1]
        return rates

    @property
    def misplacement_m(self) -> Array:
        """Displacement of features since the first scan that correction has not removed, (n, 2)."""
        followed = self.center_m - self.center_m[:1]
        misplaced: Array = self.drift_m - self.drift_m[:1] - followed
        return misplaced

    @classmethod
    def of(cls, scans: Sequence[DriftScan], updates: Sequence[Update]) -> DriftRecord:
        """Return the record of a tracker's updates for scans."""
        after = [update.after for update in updates]
        return cls(
            keys=tuple(scan.key for scan in scans),
            time_s=np.array([scan.mid_s for scan in scans]),
            center_m=np.array([scan.region.center_m for scan in scans]).reshape(-1, 2),
            drift_m=np.array(
                [drift_at(one.mapping.matrix, scan.region.center_m) for one, scan in zip(after, scans, strict=True)]
            ).reshape(-1, 2),
            covariance_m2=np.array([one.covariance_m2 for one in after]).reshape(-1, 2, 2),
            rate_m_s=np.array([one.rate_m_s for one in after]).reshape(-1, 2),
            matched=np.array([update.matched for update in updates], dtype=bool),
            reasons=tuple(update.reason for update in updates),
            outcomes=tuple(update.outcome for update in updates),
            failures=tuple(sum(bool(one.failure) for one in u.registrations.values()) for u in updates),
        )

    def write(self, path: Path, tip_changed: Sequence[str]) -> None:
        """Write the record as CSV, in SI units.

        Args:
            tip_changed: for each scan whether the tip has changed since the first: "yes", "no", or "" if unknown.

        Raises:
            FileError: the file can't be written.
        """
        try:
            with path.open("w", newline="", encoding="utf-8") as file:
                table = csv.writer(file)
                table.writerow((*COLUMNS, "tip_changed"))
                table.writerows([*row, changed] for row, changed in zip(self._rows(), tip_changed, strict=True))
        except OSError as error:
            raise FileError(f"can't be written: {error}", where=str(path)) from error

    def _rows(self) -> Iterable[list[str]]:
        for k, key in enumerate(self.keys):
            (xx, xy), (_, yy) = self.covariance_m2[k]
            numbers = (*self.center_m[k], *self.drift_m[k], xx, yy, xy, *self.rate_m_s[k])
            fields = [f"{self.time_s[k]:.6f}", *(f"{number:.9g}" for number in numbers)]
            how = (self.outcomes[k].label, str(self.failures[k]))
            yield [key, *fields, "yes" if self.matched[k] else "no", self.reasons[k], *how]

    @classmethod
    def read(cls, path: Path) -> DriftRecord:
        """Read a record from a file written by `write`; further columns are ignored.

        Raises:
            FileError: the file is missing, or contains another kind of table.
        """
        try:
            with path.open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
        except OSError as error:
            raise FileError(f"can't be read: {error}", where=str(path)) from error

        def numbers(*names: str) -> Array:
            return np.array([[float(row[name]) for name in names] for row in rows]).reshape(-1, len(names))

        try:
            return cls(
                keys=tuple(row["scan"] for row in rows),
                time_s=numbers("time_s")[:, 0],
                center_m=numbers("center_x_m", "center_y_m"),
                drift_m=numbers("drift_x_m", "drift_y_m"),
                covariance_m2=numbers("var_x_m2", "cov_xy_m2", "cov_xy_m2", "var_y_m2").reshape(-1, 2, 2),
                rate_m_s=numbers("rate_x_m_s", "rate_y_m_s"),
                matched=np.array([row["matched"] == "yes" for row in rows], dtype=bool),
                reasons=tuple(row["reason"] for row in rows),
                outcomes=tuple(RegistrationOutcome.from_label(row["outcome"]) for row in rows),
                failures=tuple(int(row["failures"]) for row in rows),
            )
        except (KeyError, ValueError, TypeError) as error:
            raise FileError(f"is not a table of drift: {error}", where=str(path)) from error
