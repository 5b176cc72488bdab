"""The running scan and its progress."""

from __future__ import annotations

from dataclasses import dataclass, field

from afspm.model import Region, ScanLines, ScanParameters
from afspm.model.scan_history import BegunMeasurement


@dataclass(slots=True)
class ChannelLines:
    """The received rows of one channel, by index."""

    unit: str
    region: Region
    shape: tuple[int, int]
    rows: set[int] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class DoneScan:
    """The duration of a completed scan; `parameters` is None if the scan parameters were unknown."""

    parameters: ScanParameters | None
    took_ns: int

    def resembles(self, other: RunningScan) -> bool:
        """Return whether both scans have the same size and pixels; unknown parameters count as equal."""
        ours, theirs = _extent(self.parameters), _extent(other.parameters)
        return ours is None or theirs is None or ours == theirs


@dataclass(slots=True)
class RunningScan:
    """The running scan.

    Attributes:
        begun: its start, as far as known.
        began_ns: None if the start was not observed.
        parameters: the scan parameters in force at the start; None if unknown.
        channels: received lines of each channel, where the microscope delivers lines.
        published: whether a whole channel was published.
        outside: the conditions whose band did not contain a value of an instrument so far.
    """

    begun: BegunMeasurement
    began_ns: int | None
    parameters: ScanParameters | None
    channels: dict[str, ChannelLines] = field(default_factory=dict)
    published: bool = False
    outside: set[str] = field(default_factory=set)

    @property
    def holder(self) -> str | None:
        """The component in control at the start."""
        return self.begun.holder

    def take(self, lines: ScanLines) -> None:
        if self.began_ns is None:
            self.began_ns = lines.began_ns
        channel = self.channels.get(lines.channel)
        if channel is None or channel.shape != lines.shape:
            channel = self.channels[lines.channel] = ChannelLines(lines.unit, lines.region, lines.shape)
        channel.rows.update(range(lines.first_row, lines.first_row + len(lines.values)))

    @property
    def rows(self) -> tuple[int, int] | None:
        """(received, total) rows of the most complete channel; None before the first lines."""
        if not self.channels:
            return None
        lines = max(self.channels.values(), key=lambda one: len(one.rows))
        return len(lines.rows), lines.shape[0]

    def progress(self, now_ns: int, expected_ns: int | None = None) -> tuple[float, int] | None:
        """Return (fraction done, ns remaining); None without an estimate.

        Args:
            expected_ns: the expected duration of the whole scan; None: extrapolate from the received lines.
        """
        if self.began_ns is None:
            return None
        gone_ns, rows = max(0, now_ns - self.began_ns), self.rows
        if expected_ns:
            return min(1.0, gone_ns / expected_ns), max(0, expected_ns - gone_ns)
        if rows is None or not rows[0]:
            return None
        part = rows[0] / rows[1]
        return part, round(gone_ns * (1.0 - part) / part)


def _extent(parameters: ScanParameters | None) -> tuple[object, object] | None:
    if parameters is None or not isinstance(parameters.region, Region):
        return None
    return parameters.region.size_m, parameters.shape
