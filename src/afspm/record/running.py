"""A scan that is being taken, and how far it is."""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

from afspm.model import Region, ScanLines, ScanParameters

COMPARED = 5  # scans before, by which it is told how long one takes


@dataclass(slots=True)
class Lines:
    """What has come of one channel: its rows, by index."""

    unit: str
    region: Region
    shape: tuple[int, int]
    rows: set[int] = field(default_factory=set)


class Taken(Protocol):
    """A scan taken before."""

    @property
    def time_ns(self) -> int: ...
    @property
    def began_ns(self) -> int | None: ...
    @property
    def shape(self) -> tuple[int, int]: ...
    @property
    def region(self) -> Region: ...
    @property
    def interrupted(self) -> bool: ...


@dataclass(slots=True)
class RunningScan:
    """A scan that is being taken.

    Attributes:
        began_ns: None if its beginning was not seen.
        holder: who was in control when it began.
        parameters: that were in force then; None if they are not known.
        channels: what has come of each, where the microscope delivers lines.
    """

    began_ns: int | None
    holder: str | None
    parameters: ScanParameters | None
    channels: dict[str, Lines] = field(default_factory=dict)

    def take(self, lines: ScanLines) -> None:
        """Lines of it came."""
        if self.began_ns is None:
            self.began_ns = lines.began_ns
        channel = self.channels.get(lines.channel)
        if channel is None or channel.shape != lines.shape:
            channel = self.channels[lines.channel] = Lines(lines.unit, lines.region, lines.shape)
        channel.rows.update(range(lines.first_row, lines.first_row + len(lines.values)))

    @property
    def rows(self) -> tuple[int, int] | None:
        """(those that have come, all); None where no lines are delivered."""
        if not self.channels:
            return None
        lines = max(self.channels.values(), key=lambda one: len(one.rows))
        return len(lines.rows), lines.shape[0]

    def expected_ns(self, before: Iterable[Taken]) -> int | None:
        """How long it should take: as those before of the same size and pixels did. None if there were none.

        Args:
            before: newest first.
        """
        if self.parameters is None or not isinstance(self.parameters.region, Region):
            return None
        size_m, shape = self.parameters.region.size_m, self.parameters.shape
        took = {
            scan.time_ns: scan.time_ns - scan.began_ns
            for scan in before
            if scan.began_ns is not None
            and not scan.interrupted
            and (scan.region.size_m, scan.shape) == (size_m, shape)
        }
        durations = list(took.values())[:COMPARED]
        return round(statistics.median(durations)) if durations else None

    def progress(self, now_ns: int, before: Iterable[Taken] = ()) -> tuple[float, int] | None:
        """(the part that is done, 0 to 1, and how many ns remain); None if nothing is known to tell it by."""
        if self.began_ns is None:
            return None
        gone_ns, rows = max(0, now_ns - self.began_ns), self.rows
        expected_ns = self.expected_ns(before)
        if expected_ns:
            return min(1.0, gone_ns / expected_ns), max(0, expected_ns - gone_ns)
        if rows is None or not rows[0]:
            return None
        part = rows[0] / rows[1]
        return part, round(gone_ns * (1.0 - part) / part)
