"""A scan that is being taken, and how far it is."""

from __future__ import annotations

from dataclasses import dataclass, field

from afspm.model import Region, ScanLines, ScanParameters


@dataclass(slots=True)
class ChannelLines:
    """The rows of one channel that have come, by index."""

    unit: str
    region: Region
    shape: tuple[int, int]
    rows: set[int] = field(default_factory=set)


@dataclass(frozen=True, slots=True)
class DoneScan:
    """The duration of a scan, with the parameters that were in force; None if they were not known."""

    parameters: ScanParameters | None
    took_ns: int

    def resembles(self, other: RunningScan) -> bool:
        """Return whether both are of the same size and pixels, as far as is known."""
        ours, theirs = _extent(self.parameters), _extent(other.parameters)
        return ours is None or theirs is None or ours == theirs


@dataclass(slots=True)
class RunningScan:
    """A scan that is being taken.

    Attributes:
        began_ns: None if its beginning was not seen.
        holder: who was in control when it began.
        parameters: that were in force then; None if they are not known.
        setpoint: of the feedback then; None if it was not published.
        channels: what has come of each, where the microscope delivers lines.
    """

    began_ns: int | None
    holder: str | None
    parameters: ScanParameters | None
    setpoint: float | None = None
    channels: dict[str, ChannelLines] = field(default_factory=dict)

    def take(self, lines: ScanLines) -> None:
        """Take lines of the scan."""
        if self.began_ns is None:
            self.began_ns = lines.began_ns
        channel = self.channels.get(lines.channel)
        if channel is None or channel.shape != lines.shape:
            channel = self.channels[lines.channel] = ChannelLines(lines.unit, lines.region, lines.shape)
        channel.rows.update(range(lines.first_row, lines.first_row + len(lines.values)))

    @property
    def rows(self) -> tuple[int, int] | None:
        """(those that have come, all); None where no lines are delivered."""
        if not self.channels:
            return None
        lines = max(self.channels.values(), key=lambda one: len(one.rows))
        return len(lines.rows), lines.shape[0]

    def progress(self, now_ns: int, expected_ns: int | None = None) -> tuple[float, int] | None:
        """(the part that is done, 0 to 1, and how many ns remain); None if nothing is known to tell it by.

        Args:
            expected_ns: how long such a scan takes; None: told by its lines.
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
