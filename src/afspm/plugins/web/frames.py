"""The newest picture of each channel, partial or finished, and earlier pictures within a memory bound."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from afspm.model import ChannelRoles, Region, Scan, ScanLines

MEMORY_BYTES = 192 << 20
MOST_CHANNELS = 64
FrameKey = tuple[int, str]
"""Key of a frame: time in ns, and channel."""


@dataclass(frozen=True, eq=False, slots=True)
class ChannelFrame:
    """One channel of a scan, with the rows measured so far.

    Attributes:
        number: higher than the number of every earlier frame of any channel; negative for a frame from the record.
        values: [y, x], y ascending, as published; NaN in rows that have not arrived yet.
        time_ns: the end; None while the scan runs.
        began_ns: start of the scan, from its lines; None if the scan arrived in one piece.
        rows: number of arrived rows.
        newest_row: index of the last arrived row; None for a finished frame.
        changed_row: index of the first row with a changed tip, from the verdict on lines; None without a change.
    """

    number: int
    channel: str
    unit: str
    region: Region
    values: NDArray[np.float64]
    time_ns: int | None
    began_ns: int | None = None
    rows: int = 0
    newest_row: int | None = None
    changed_row: int | None = None

    @property
    def complete(self) -> bool:
        return self.time_ns is not None

    # by number, for the cache of pictures: arrays have no truth value
    def __eq__(self, other: object) -> bool:
        return isinstance(other, ChannelFrame) and self.number == other.number

    def __hash__(self) -> int:
        return self.number


class FrameStore:
    """A store of frames for pictures. Not thread-safe.

    Args:
        memory_bytes: bound for all finished frames together, and again for all partial frames together.

    Attributes:
        roles: the microscope's channels by their roles.
    """

    def __init__(self, memory_bytes: int = MEMORY_BYTES) -> None:
        self.kept_bytes = 0
        self.roles = ChannelRoles()
        self._memory_bytes = memory_bytes
        self._number = 0
        self._newest: dict[str, ChannelFrame] = {}
        self._came: dict[str, NDArray[np.bool_]] = {}
        self._kept: OrderedDict[FrameKey, ChannelFrame] = OrderedDict()
        self._changed: tuple[int | None, int] | None = None  # start of a scan, and its first row with a changed tip

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels: the topography first, the others in the order of their first appearance."""
        return self.roles.topography_first(self._newest)

    def take_scan(self, scan: Scan, time_ns: int) -> None:
        """Add a finished channel. A scan without values, or not newer than the present frame, is ignored.

        Args:
            time_ns: the packet's time, for scans without a time of their own.
        """
        if not scan.values.size:
            return
        before = self._newest.get(scan.channel)
        time_ns = scan.time_ns or time_ns
        if before is not None and before.time_ns is not None and time_ns <= before.time_ns:
            return  # a replay of an older scan
        self._came.pop(scan.channel, None)
        began_ns = before.began_ns if before is not None and not before.complete else None
        frame = ChannelFrame(
            self._next(), scan.channel, scan.unit, scan.region, scan.values, time_ns, began_ns, scan.shape[0],
            changed_row=self._changed_row(began_ns),
        )  # fmt: skip
        self._put(frame)
        self._kept[time_ns, frame.channel] = frame
        self.kept_bytes += frame.values.nbytes
        while self.kept_bytes > self._memory_bytes and len(self._kept) > 1:
            self.kept_bytes -= self._kept.popitem(last=False)[1].values.nbytes

    def take_lines(self, lines: ScanLines) -> None:
        """Add lines of a running scan; lines of a finished scan, or beyond the memory bound, are ignored."""
        before = self._newest.get(lines.channel)
        if before is not None and before.complete and self._is_over(before, lines):
            return
        grows = (
            before is not None
            and not before.complete
            and before.began_ns == lines.began_ns
            and before.values.shape == lines.shape
        )
        # a growing frame already has its memory
        if not grows and not self._has_room(lines):
            return
        picture = lines.into(before.values if grows and before is not None else None)
        came = self._came[lines.channel] if grows else np.zeros(lines.shape[0], np.bool_)
        last = lines.first_row + len(lines.values)
        # a row above is already there: the scan runs downwards
        downwards = last < len(came) and bool(came[last])
        came[lines.first_row : last] = True
        self._came[lines.channel] = came
        self._put(ChannelFrame(
            self._next(), lines.channel, lines.unit, lines.region, picture, None, lines.began_ns,
            rows=int(came.sum()), newest_row=lines.first_row if downwards else last - 1,
            changed_row=self._changed_row(lines.began_ns),
        ))  # fmt: skip

    def take_change(self, began_ns: int | None, row: int) -> None:
        """Mark the first row with a changed tip in all channels of the scan that began at `began_ns`."""
        self._changed = began_ns, row
        for frame in list(self._newest.values()):
            if frame.began_ns is not None and frame.began_ns == began_ns:
                self._put(replace(frame, number=self._next(), changed_row=row))

    def newest(self, channel: str | None = None) -> ChannelFrame | None:
        """Return the newest frame of a channel (None: the first channel); a partial frame is copied."""
        frame = self._of(channel)
        return frame if frame is None or frame.complete else replace(frame, values=frame.values.copy())

    @property
    def last_number(self) -> int:
        """The number of the newest frame of all channels; 0 if there is none."""
        return self._number

    def newest_number(self, channel: str | None = None) -> tuple[int, bool]:
        """Return (number, True if finished) of the newest frame, without a copy; 0 if there is none."""
        frame = self._of(channel)
        return (0, False) if frame is None else (frame.number, frame.complete)

    def kept(self, time_ns: int, channel: str) -> ChannelFrame | None:
        """Return an earlier finished frame; None if the store does not contain the frame any more."""
        return self._kept.get((time_ns, channel))

    def _of(self, channel: str | None) -> ChannelFrame | None:
        wanted = next(iter(self.channels), "") if channel is None else channel
        return self._newest.get(wanted)

    def _changed_row(self, began_ns: int | None) -> int | None:
        is_of_it = self._changed is not None and began_ns is not None and self._changed[0] == began_ns
        return self._changed[1] if self._changed is not None and is_of_it else None

    def _has_room(self, lines: ScanLines) -> bool:
        # a few lines may announce a scan of millions of lines
        rows, columns = lines.shape
        others = (one for one in self._newest.values() if not one.complete and one.channel != lines.channel)
        return 8 * rows * columns + sum(one.values.nbytes for one in others) <= self._memory_bytes

    def _put(self, frame: ChannelFrame) -> None:
        self._newest[frame.channel] = frame
        if len(self._newest) > MOST_CHANNELS:
            oldest = min(self._newest.values(), key=lambda one: one.number).channel
            del self._newest[oldest]
            self._came.pop(oldest, None)

    def _is_over(self, finished: ChannelFrame, lines: ScanLines) -> bool:
        if lines.began_ns is None:
            return False
        if finished.began_ns is not None:
            return lines.began_ns <= finished.began_ns
        return finished.time_ns is not None and lines.began_ns < finished.time_ns

    def _next(self) -> int:
        self._number += 1
        return self._number


def number_or_none(value: float) -> float | None:
    """Return a finite number, or None, because JSON has no NaN."""
    return value if math.isfinite(value) else None
