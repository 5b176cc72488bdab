"""Messages about drift: jobs for the worker, its reports, and requests for rescans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from afspm.basics import Plain
from afspm.model import XY, Region, RegistrationOutcome, RescanKind, Scan
from afspm.plugins.drift.frame.positions import PlaceCodec
from afspm.plugins.drift.track.mapping import Mapping

Matrix = list[list[float]]


@dataclass(frozen=True)
class Registered:
    """Result of the registration of a scan.

    Attributes:
        key: key of the scan.
        time_s: middle of the scan, experiment time.
        matrix: 3 x 3 matrix of the mapping at this time.
        covariance_m2, rate_m_s, rate_covariance: see `drift.track.tracking.Prediction`; empty if unknown.
        outcome, lost, reason: see `drift.track.tracking.Update`.
        residual_m: (x, y) measured minus predicted position of the sample in tip coordinates; empty if unknown.
        references: names of the scans with which this scan was registered successfully.
        rescan: reason for a rescan; empty if the scan need not be repeated.
        forecast: the new forecast, for `forecast_from_dict`; None: unchanged.
        failures: errors of the estimator with this scan, each with its pair of scans.
    """

    key: str
    time_s: float
    matrix: Matrix
    covariance_m2: Matrix
    rate_m_s: list[float]
    rate_covariance: Matrix
    outcome: RegistrationOutcome
    lost: bool
    reason: str
    residual_m: list[float]
    references: list[str]
    rescan: str
    forecast: Plain | None
    failures: list[str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "outcome", RegistrationOutcome(self.outcome))  # a saved state has it as a number

    @property
    def matched(self) -> bool:
        return self.outcome.is_registered

    @property
    def sd_m(self) -> float:
        """Standard deviation of the position along its most uncertain axis; NaN if unknown."""
        if not self.covariance_m2:
            return math.nan
        (xx, xy), (_, yy) = self.covariance_m2
        return math.sqrt(max((xx + yy) / 2 + math.hypot((xx - yy) / 2, xy), 0.0))

    @property
    def mapping(self) -> Mapping:
        return Mapping(self.matrix)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Forecasted:
    """Report that the worker has started, or has a new forecast without a new scan."""

    forecast: Plain | None


@dataclass(frozen=True)
class NotRegistered:
    """Report that the worker could not process a scan."""

    key: str
    reason: str


@dataclass(frozen=True)
class WorkerGone:
    """Report that the worker has ended, or could not be started."""

    reason: str


WorkerReport = Registered | Forecasted | NotRegistered | WorkerGone


@dataclass(frozen=True)
class ScanJob:
    """Job to register a scan; the scan's region is in tip coordinates.

    Attributes:
        start_s, end_s: start and end of the scan, experiment time.
        upwards: direction of the slow axis; None if unknown.
        asked: requested region, in sample coordinates; None if unknown.
    """

    key: str
    scan: Scan
    start_s: float
    end_s: float
    upwards: bool | None
    asked: Region | None


@dataclass(frozen=True)
class StartWorker:
    """Job that starts the worker; a running worker is killed, and its job is dropped."""


@dataclass(frozen=True)
class Compensated:
    """Job to follow a controller that moves the tip with this velocity from this time on."""

    time_s: float
    velocity_m_s: tuple[float, float]


WorkerJob = StartWorker | ScanJob | Compensated
"""Jobs for the worker. A repeated job for a scan gets the answer of the first."""


@dataclass(frozen=True)
class RescanWanted:
    """A request to the Rescanner.

    Attributes:
        requested: ScanParameters2d of the region, in the components' coordinates.
        shape: (rows, columns); None: unchanged.
        upwards: direction of the rescan; None: any.
    """

    kind: RescanKind
    requested: bytes
    shape: tuple[int, int] | None
    reason: str
    time_ns: int
    upwards: bool | None = None


class DriftCodec(PlaceCodec, Protocol):
    """Part of the wire format that drift compensation needs."""

    def encode_mapping(
        self, registered: Registered, filename: str, center_m: XY, *, correcting: bool, channel: str | None
    ) -> bytes:
        """Return the DriftMapping of a scan as the payload of a packet; `center_m` is in tip coordinates."""

    def encode_rescan(self, wanted: RescanWanted) -> bytes:
        """Return a DriftRescan as the payload of a packet."""
