"""`ScanAssembler`: the assembly of packets into measurements: the channels of a scan, its lines, its end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from afspm.model import Packet, Scan, ScanLines, ScopeState, ScopeStatus, Spectrum


@dataclass
class AssembledScan:
    """The packets of one scan, open or ended.

    Attributes:
        channels: the packets of the channels with their content; empty if the scan was interrupted.
        lines: the packets with the scan's lines and their content, published while the scan ran.
        interrupted_ns: the time of the interruption; None if the scan is complete.
    """

    channels: list[tuple[Packet, Scan]] = field(default_factory=list)
    lines: list[tuple[Packet, ScanLines]] = field(default_factory=list)
    interrupted_ns: int | None = None

    def packets(self) -> Iterator[Packet]:
        """Yield all packets of the scan."""
        yield from (packet for packet, _ in self.lines)
        yield from (packet for packet, _ in self.channels)

    def as_seen(self) -> list[Scan]:
        """Return the lines of an interrupted scan, one scan for each channel; missing rows are NaN."""
        pictures: dict[str, NDArray[np.float64]] = {}
        newest: dict[str, ScanLines] = {}
        for _, lines in self.lines:
            before = pictures.get(lines.channel)
            pictures[lines.channel] = lines.into(before if before is not None and before.shape == lines.shape else None)
            newest[lines.channel] = lines
        shape = next((lines.shape for lines in newest.values()), None)
        return [
            Scan(lines.region, channel, lines.unit, pictures[channel], self.interrupted_ns)
            for channel, lines in newest.items()
            if lines.shape == shape
        ]


@dataclass(frozen=True)
class AssembledSpectrum:
    """A spectrum with its packet."""

    packet: Packet
    spectrum: Spectrum

    def packets(self) -> Iterator[Packet]:
        yield self.packet


Assembled = AssembledScan | AssembledSpectrum


class ScanAssembler:
    """The grouping of packets by measurement, in the order of publication.

    Args:
        state: the last published state of the microscope.
    """

    def __init__(self, state: ScopeState = ScopeState.UNDEFINED) -> None:
        self._state = state
        self._open = AssembledScan()

    def copy(self) -> ScanAssembler:
        """Return a copy of the state, for a rollback."""
        other = ScanAssembler(self._state)
        other._open = AssembledScan(list(self._open.channels), list(self._open.lines), self._open.interrupted_ns)
        return other

    def waiting(self) -> Iterator[Packet]:
        """Return the packets of the open scan."""
        return self._open.packets()

    def scan(self, packet: Packet, scan: Scan) -> list[Assembled]:
        """Add a channel; return the previous scan if the channel belongs to another scan."""
        over: list[Assembled] = []
        if self._open.channels and not _same(self._open, scan):
            over = self.flush()
        self._open.channels.append((packet, scan))
        return over

    def lines(self, packet: Packet, lines: ScanLines) -> list[Assembled]:
        """Add lines of a running scan; return the previous scan if these lines belong to another scan.

        Repeated lines are accepted, since a restarted translator publishes a scan from its first row again.
        """
        before = self._open.lines[-1][1] if self._open.lines else None
        over: list[Assembled] = []
        if self._open.channels or (before is not None and (before.region, before.shape) != (lines.region, lines.shape)):
            over = self.finish()
        self._open.lines.append((packet, lines))
        return over

    def spectrum(self, packet: Packet, spectrum: Spectrum) -> list[Assembled]:
        """Return a spectrum, which is complete at once, after the open scan if that has channels."""
        return [*self.flush(), AssembledSpectrum(packet, spectrum)]

    def status(self, status: ScopeStatus, time_ns: int) -> list[Assembled]:
        """Process a new state of the microscope; return the scan that ends with this state."""
        before, self._state = self._state, status.state
        # a scan with channels is complete: translators publish none of an interrupted scan
        if status.state is ScopeState.INTERRUPTED and before is ScopeState.SCANNING and not self._open.channels:
            interrupted, self._open = self._open, AssembledScan()
            interrupted.interrupted_ns = time_ns
            return [interrupted]
        if status.state is ScopeState.SCANNING and before is not ScopeState.SCANNING:
            return self.finish()
        # lines without channels stay open: some translators become free before they publish the scan
        return self.flush() if status.state is ScopeState.FREE else []

    def flush(self) -> list[Assembled]:
        """End the open scan if one of its channels has arrived."""
        if not self._open.channels:
            return []
        taken, self._open = self._open, AssembledScan()
        return [taken]

    def finish(self) -> list[Assembled]:
        """End the open scan; a scan without channels counts as interrupted, at the time of its last lines."""
        if not self._open.channels and not self._open.lines:
            return []
        taken, self._open = self._open, AssembledScan()
        if not taken.channels:
            # not the time of what comes next: by then the same scan may have been requested again
            taken.interrupted_ns = taken.lines[-1][0].time_ns or 0
        return [taken]


def _same(taken: AssembledScan, scan: Scan) -> bool:
    # a restarted translator publishes channels again: they count as the same scan. Some controllers write a file for
    # each channel: their channels share the time, and a channel known from another file belongs to another scan.
    first = taken.channels[0][1]
    if (scan.region, scan.shape, scan.time_ns) != (first.region, first.shape, first.time_ns):
        return False
    for _, other in taken.channels:
        if other.channel == scan.channel:
            return scan.filename == other.filename and (scan.filename != "" or scan.time_ns is not None)
    return scan.time_ns is not None or scan.filename == first.filename
