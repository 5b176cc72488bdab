"""Channels of a scan, which arrive one by one: pairs of trace and retrace, and a warning about missing channels."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass

from afspm.basics.units import convert
from afspm.components.tip_judge import TipJudge, Verdict
from afspm.model import Scan

ENOUGH_SCANS = 3  # before a channel counts as missing; the channels of one scan come one by one


@dataclass(frozen=True)
class HeightPair:
    """Trace and, if recorded, retrace of one scan."""

    trace: Scan
    retrace: Scan | None

    def judged_by(self, judge: TipJudge, *, learns: bool) -> Verdict:
        """Return the judge's verdict on the tip; `learns` as in `TipJudge.judge`.

        Raises:
            UnitError: the values of a channel are not lengths.
        """
        retrace = None if self.retrace is None else self.retrace.values * convert(1.0, self.retrace.unit, "m")
        trace = self.trace.values * convert(1.0, self.trace.unit, "m")
        settings = self.trace.picture_settings
        return judge.judge(trace, retrace, self.trace.region, settings=settings, learns=learns)


class ChannelPairing:
    """A collector of channels until trace and retrace of one scan are there.

    Args:
        channel, retrace_channel: the height channels, by role or name; the second is empty if retrace is not recorded.
    """

    def __init__(self, channel: str, retrace_channel: str) -> None:
        self._channel, self._retrace_channel = channel, retrace_channel
        self._seen: dict[str, Scan] = {}

    @property
    def channels(self) -> tuple[str, str]:
        return self._channel, self._retrace_channel

    def add(self, scan: Scan) -> HeightPair | None:
        """Add a channel; return the pair once trace and retrace are there."""
        wanted = next((one for one in self.channels if one and scan.is_of(one)), None)
        if wanted is None or not scan.values.size:
            return None
        self._seen[wanted] = scan
        trace, retrace = self._seen.get(self._channel), self._seen.get(self._retrace_channel)
        if trace is None or (self._retrace_channel and (retrace is None or not _belong_together(trace, retrace))):
            return None
        self._seen.clear()
        return HeightPair(trace, retrace)


class MissingChannels:
    """A monitor that logs one error if a required channel is missing from the first `ENOUGH_SCANS` scans.

    Args:
        channels: the required channels, by role or name; empty names are ignored.
    """

    def __init__(self, channels: Collection[str], log: logging.Logger) -> None:
        self._missing = set(filter(None, channels))
        self._others: dict[str, None] = {}
        self._times: set[int | None] = set()
        self._log = log

    def see(self, scan: Scan) -> None:
        self._missing = {channel for channel in self._missing if not scan.is_of(channel)}
        if not self._missing:
            return
        self._others[scan.channel] = None
        self._times.add(scan.time_ns)
        if len(self._times) >= ENOUGH_SCANS:
            missing, there = " and ".join(sorted(self._missing)), ", ".join(self._others)
            self._log.error(
                "the scans have no channel %s, so nothing is judged. They have %s: set one of them", missing, there
            )
            self._missing.clear()


def _belong_together(one: Scan, other: Scan) -> bool:
    if one.region != other.region or one.shape != other.shape:
        return False
    return one.time_ns == other.time_ns or bool(one.filename and one.filename == other.filename)
