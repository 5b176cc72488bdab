"""`MeasurementHistory`: the scans, spectra, drift and found places of an experiment, without their values."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import TYPE_CHECKING, TypeVar

from afspm.basics import same_kind
from afspm.basics.units import convert
from afspm.model import Frame, MeasurementConditions, Region, RegistrationOutcome, Scan, ScanParameters, Spectrum
from afspm.model.geometry import XY
from afspm.model.scan_history import BegunMeasurement
from afspm.night.running_scan import DoneScan, RunningScan
from afspm.record import drift_at, drift_knowledge

if TYPE_CHECKING:
    from afspm.wire.messages import DriftMapping, SpatialPointWithScoreList

MOST_MEASURED = 100_000
MOST_TARGETS = 1_000
SOON_NS = 1_000_000_000
COMPARED = 5  # earlier scans, whose median duration is the prediction
K = TypeVar("K")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """One channel of a scan, without its values.

    Attributes:
        time_ns: the end of the scan, or its interruption.
        began_ns: None if the start was not observed.
        shape: (rows, columns).
        holder: the component in control; None if the microscope was free, or the holder is unknown.
        interrupted: the scan is incomplete.
        setpoint: the feedback setpoint at the start, in the unit of the operating mode; None if not published.
        number: the number of the scan in the run, as in its record: from 1, the same for all its channels.
        outside: the conditions whose band did not contain a value of an instrument during the scan.
    """

    time_ns: int
    began_ns: int | None
    channel: str
    unit: str
    region: Region
    shape: tuple[int, int]
    filename: str = ""
    holder: str | None = None
    interrupted: bool = False
    setpoint: float | None = None
    number: int = 0
    outside: tuple[str, ...] = ()

    def is_of_scan(self, other: ScanSummary) -> bool:
        """Return whether both are channels of one scan."""
        if self.channel == other.channel or self.region != other.region:
            return False
        if self.began_ns is not None and other.began_ns is not None:
            return self.began_ns == other.began_ns
        return abs(self.time_ns - other.time_ns) <= SOON_NS


@dataclass(frozen=True, slots=True)
class SpectrumSummary:
    """A spectrum, without its values. `position_m` is (x, y) in `frame`; None if unknown. `roles`: "" for no role."""

    time_ns: int
    kind: str
    position_m: XY | None
    frame: Frame
    names: tuple[str, ...]
    units: tuple[str, ...]
    filename: str = ""
    holder: str | None = None
    roles: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class FoundPlace:
    """A place found by a component; `score` is None without a score."""

    xy_m: XY
    score: float | None = None


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """The drift at one scan.

    Attributes:
        translation_m: (x, y) displacement of the sample under the tip since the start, in tip coordinates.
        rate_m_s: (x, y) velocity of the sample at that time.
        matched: whether the scan was registered; otherwise the point is a prediction.
        lost: the position of the sample is no longer known.
        correcting: whether components received sample coordinates.
        reason: the reason why the scan was not registered, or only coarsely.
        outcome: how the position of the scan is known.
        sd_m: standard deviation of the position along its most uncertain axis; None if unknown.
        failures: the number of pairs of scans over which the estimator failed with an error of its own.
        filename: the file of the scan.
    """

    time_ns: int
    translation_m: XY
    rate_m_s: XY
    matched: bool = True
    lost: bool = False
    correcting: bool = False
    reason: str = ""
    outcome: RegistrationOutcome = RegistrationOutcome.REGISTERED
    sd_m: float | None = None
    failures: int = 0
    filename: str = ""


class MeasurementHistory:
    """Summaries of measurements, in the order of arrival; the oldest are dropped beyond `MOST_MEASURED`.

    Attributes:
        running: the running scan, or None.
        count: the number of scans so far, with scans interrupted before their first line, as in the record.
        opposite_ns: times of requests for a scan in the opposite direction, newest last.
    """

    def __init__(self) -> None:
        self.running: RunningScan | None = None
        self.count = 0
        self.opposite_ns: deque[int] = deque(maxlen=20)
        self._done: deque[DoneScan] = deque(maxlen=20)
        self._scans: dict[tuple[object, ...], ScanSummary] = {}
        self._spectra: dict[tuple[object, ...], SpectrumSummary] = {}
        self._conditions: dict[int, MeasurementConditions] = {}
        self._drift: dict[int, DriftPoint] = {}
        self._places: dict[str, tuple[FoundPlace, ...]] = {}

    @property
    def scans(self) -> Sequence[ScanSummary]:
        """A summary for each channel of each scan."""
        return tuple(self._scans.values())

    @property
    def spectra(self) -> Sequence[SpectrumSummary]:
        return tuple(self._spectra.values())

    @property
    def drift(self) -> Sequence[DriftPoint]:
        return tuple(self._drift.values())

    @property
    def places(self) -> Sequence[FoundPlace]:
        """The places in the newest list of each channel."""
        return tuple(place for found in self._places.values() for place in found)

    def scan_progress(self, now_ns: int) -> tuple[float, int] | None:
        """Return (fraction done, ns remaining) of the running scan; None without an estimate."""
        if self.running is None:
            return None
        took_ns = [scan.took_ns for scan in reversed(self._done) if scan.resembles(self.running)][:COMPARED]
        return self.running.progress(now_ns, round(median(took_ns)) if took_ns else None)

    def begin_scan(self, begun: BegunMeasurement | None, parameters: ScanParameters | None, time_ns: int) -> None:
        """Take a scan for the running one, unless it is known.

        Args:
            parameters: the scan parameters in force.
            time_ns: the end of the one before, if that has its result.
        """
        running = self.running
        if begun is None or (running is not None and running.begun.number == begun.number):
            return
        if running is not None and running.published:
            self.end_scan(time_ns, interrupted=False)
        self.running = RunningScan(begun, begun.began_ns, parameters)

    def end_scan(self, time_ns: int, *, interrupted: bool) -> None:
        """End the running scan. After an interruption, add a summary for each channel with received lines.

        A scan whose channels were published is complete, as for the record.
        """
        running = self.running
        if running is None:
            return
        if interrupted and not running.published:
            if not running.channels:
                self.count += 1
            for channel, lines in running.channels.items():
                summary = ScanSummary(
                    time_ns, running.began_ns, channel, lines.unit, lines.region, lines.shape,
                    holder=running.holder, interrupted=True, setpoint=_setpoint(running.begun),
                )  # fmt: skip
                self._add_channel(summary)
        elif running.began_ns is not None:
            self._done.append(DoneScan(running.parameters, time_ns - running.began_ns))
        self.running = None

    def add_scan(
        self, scan: Scan, time_ns: int, begun: BegunMeasurement, holder: str | None, outside: Iterable[str] = ()
    ) -> None:
        """Add a channel of a scan.

        Args:
            begun: its start, as far as known.
            holder: the component in control now, which counts if the start was not seen.
            outside: the conditions that do not hold now.
        """
        began_ns, outside = begun.began_ns, set(outside)
        if self.running is not None and self.running.begun.number == begun.number:
            began_ns = self.running.began_ns if began_ns is None else began_ns
            self.running.published = True
            outside |= self.running.outside
        holder = begun.holder if begun.number or begun.asked_by else holder
        summary = ScanSummary(
            scan.time_ns or time_ns, began_ns, scan.channel, scan.unit, scan.region, scan.shape, scan.filename,
            holder, setpoint=_setpoint(begun), outside=tuple(sorted(outside)),
        )  # fmt: skip
        self._add_channel(summary)

    def _add_channel(self, summary: ScanSummary) -> None:
        last = next(reversed(self._scans.values()), None)
        summary = _sharing(summary, last)
        key = (summary.time_ns, summary.channel, summary.region, summary.interrupted)
        if key in self._scans:
            return
        if last is None or last.number != self.count or not summary.is_of_scan(last):
            self.count += 1
        _keep(self._scans, key, replace(summary, number=self.count))

    def add_spectrum(self, spectrum: Spectrum, time_ns: int, holder: str | None) -> None:
        measured_ns = spectrum.time_ns or time_ns
        summary = SpectrumSummary(
            measured_ns, spectrum.kind, spectrum.position_m, spectrum.frame, spectrum.names, spectrum.units,
            spectrum.filename, holder, tuple(spectrum.roles.roles_of(spectrum.names)),
        )  # fmt: skip
        _keep(self._spectra, (measured_ns, spectrum.kind, spectrum.position_m), summary)

    def add_conditions(self, conditions: MeasurementConditions) -> None:
        _keep(self._conditions, conditions.time_ns, conditions)

    def conditions(self, time_ns: int) -> MeasurementConditions | None:
        """Return the tip at both ends of the scan or spectrum of this time; None if not published."""
        return self._conditions.get(time_ns)

    def add_drift(self, message: DriftMapping) -> None:
        """Add a displacement of the sample; a message without a mapping is ignored."""
        if len(message.matrix) != 6 or len(message.center) != 2:
            return
        import numpy as np  # imported late: `afspm status` of most runs needs no arrays

        drift_x, drift_y = drift_at(np.array(message.matrix).reshape(2, 3), message.center)
        rate_x, rate_y = message.rate if len(message.rate) == 2 else (0.0, 0.0)
        at_ns = message.timestamp.ToNanoseconds()
        point = DriftPoint(
            at_ns, (float(drift_x), float(drift_y)), (rate_x, rate_y), message.matched, message.lost,
            message.correcting, message.reason, *drift_knowledge(message), message.failures, message.filename,
        )  # fmt: skip
        _keep(self._drift, at_ns, point)

    def set_places(self, message: SpatialPointWithScoreList) -> None:
        """Replace a channel's places by the places with length units in the message."""
        found = ((one.spatial.point, one.spatial.units or "m", one) for one in message.spatials[-MOST_TARGETS:])
        self._places[message.channel] = tuple(
            FoundPlace(
                (convert(point.x, unit, "m"), convert(point.y, unit, "m")),
                one.score if one.HasField("score") else None,
            )
            for point, unit, one in found
            if same_kind(unit, "m")
        )


def _setpoint(begun: BegunMeasurement) -> float | None:
    return begun.feedback.setpoint if begun.feedback else None


def _sharing(summary: ScanSummary, last: ScanSummary | None) -> ScanSummary:
    # a page keeps up to a hundred thousand summaries: equal parts of neighbours share one object to save memory
    channel, unit = sys.intern(summary.channel), sys.intern(summary.unit)
    if last is None:
        return replace(summary, channel=channel, unit=unit)
    return replace(
        summary,
        channel=channel,
        unit=unit,
        time_ns=_shared(last.time_ns, summary.time_ns),
        region=_shared(last.region, summary.region),
        shape=_shared(last.shape, summary.shape),
        filename=_shared(last.filename, summary.filename),
    )


def _shared(before: V, now: V) -> V:
    return before if before == now else now


def _keep(kept: dict[K, V], key: K, thing: V) -> None:
    kept.setdefault(key, thing)
    if len(kept) > MOST_MEASURED:
        del kept[next(iter(kept))]
