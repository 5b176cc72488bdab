"""Timing of scans: start of the running scan, and expected duration of a scan."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.basics import replace
from afspm.model import ScopeState, ScopeStatus

XY = tuple[float, float]
Shape = tuple[int, int]

_KEPT = 16


@dataclass(frozen=True)
class ScanStart:
    """Start of a scan.

    Attributes:
        time_s: experiment time of the start.
        upwards: direction of the slow axis; None if unknown.
        was_paused: whether the scan was paused between rows.
    """

    time_s: float
    upwards: bool | None
    was_paused: bool = False


@dataclass(frozen=True)
class ScanStartTracker:
    """Tracker of the microscope's states, which finds the start of scans.

    SCANNING is also published after a pause, and to a restarted scheduler, although the scan began earlier.
    """

    begun: ScanStart | None = None
    is_scanning: bool = False

    def with_state(self, status: ScopeStatus, time_s: float, upwards: bool | None) -> ScanStartTracker:
        """Process a scope state, with the scan direction in force.

        UNDEFINED is ignored, because a disconnected microscope continues its scan.
        """
        if status.state is ScopeState.UNDEFINED:
            return self
        is_scanning, begun = status.state is ScopeState.SCANNING, self.begun
        if is_scanning and not self.is_scanning:
            begun = ScanStart(time_s, upwards, status.paused is True)
        elif is_scanning and begun is not None and status.paused is True:
            begun = replace(begun, was_paused=True)
        return ScanStartTracker(begun, is_scanning)

    def scan_came(self) -> ScanStartTracker:
        """Mark the scan as finished: the next SCANNING starts another scan, even without a state in between."""
        return replace(self, is_scanning=False)

    def of_scan(self, end_s: float) -> ScanStart | None:
        """Return the start of the scan that ended at `end_s`; None if unknown."""
        return self.begun if self.begun is not None and self.begun.time_s < end_s else None

    def middle_s(self, end_s: float, expected_s: float) -> float:
        """Return the middle of the scan that ended at `end_s`, from its start or, if unknown, `expected_s`."""
        begun = self.of_scan(end_s)
        return end_s - expected_s / 2 if begun is None else (begun.time_s + end_s) / 2


@dataclass(frozen=True)
class ScanDuration:
    """Measured duration of scans with one shape and size."""

    shape: Shape
    size_m: XY
    duration_s: float


@dataclass(frozen=True)
class ScanDurations:
    """Durations of finished scans, newest last; cleared when the scan speed is set."""

    known: tuple[ScanDuration, ...] = ()

    def learn(self, shape: Shape, size_m: XY, duration_s: float) -> ScanDurations:
        """Add the duration of a scan with this shape and size."""
        newest = ScanDuration(shape, _rounded(size_m), duration_s)
        others = [one for one in self.known if (one.shape, one.size_m) != (newest.shape, newest.size_m)]
        return ScanDurations((*others, newest)[-_KEPT:])

    def expected_s(self, shape: Shape | None, size_m: XY) -> float:
        """Return the expected duration of a scan in s; 0 without a measured duration.

        For a new size or shape, the duration of the latest scan is scaled by the total length of its lines.
        """
        if not self.known:
            return 0.0
        latest = self.known[-1]
        shape = latest.shape if shape is None else shape
        size_m = _rounded(size_m)
        for one in self.known:
            if (one.shape, one.size_m) == (shape, size_m):
                return one.duration_s
        return latest.duration_s * (shape[0] * size_m[0]) / (latest.shape[0] * latest.size_m[0])


def _rounded(size_m: XY) -> XY:
    # six digits: a size that a controller rounds is still the same scan
    return (float(f"{size_m[0]:.6g}"), float(f"{size_m[1]:.6g}"))
