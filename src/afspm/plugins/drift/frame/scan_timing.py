"""Timing of scans: start of the running scan, and expected duration of a scan."""

from __future__ import annotations

from dataclasses import dataclass, field

from afspm.basics import replace
from afspm.model import Scan, ScanHistory

XY = tuple[float, float]
Shape = tuple[int, int]

_KEPT, _STARTS = 16, 8


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
    """The starts of scans, and the scan direction in force at each.

    Attributes:
        history: of the microscope's measurements.
        upwards: of the newest measurements, by their number; None if unknown.
    """

    history: ScanHistory = field(default_factory=ScanHistory)
    upwards: tuple[tuple[int, bool | None], ...] = ()

    def after(self, thing: object, time_ns: int, upwards: bool | None) -> ScanStartTracker:
        """Process a published message, with the scan direction in force."""
        history = self.history.step(thing, time_ns)
        if history.count == self.history.count:
            return replace(self, history=history)
        return ScanStartTracker(history, (*self.upwards, (history.count, upwards))[-_STARTS:])

    def of_scan(self, scan: Scan, published_ns: int) -> ScanStart | None:
        """Return the start of a scan; None if unknown."""
        begun = self.history.of(scan, published_ns)
        if begun.began_ns is None:
            return None
        return ScanStart(begun.began_ns * 1e-9, dict(self.upwards).get(begun.number), begun.was_paused)


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
