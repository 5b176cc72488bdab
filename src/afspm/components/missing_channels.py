"""Whether the channels that a component judges by are measured at all: its silence would look as if all were well."""

from __future__ import annotations

import logging
from collections.abc import Collection

from afspm.model import Scan

ENOUGH = 3
"""So many scans are looked at; channels of one come one by one."""


class MissingChannels:
    """Says once that scans come, and none has a channel that is wanted.

    Args:
        channels: their names; an empty one is not wanted.
    """

    def __init__(self, channels: Collection[str], log: logging.Logger) -> None:
        self._missing = set(filter(None, channels))
        self._others: dict[str, None] = {}
        self._times: set[int | None] = set()
        self._log = log

    def see(self, scan: Scan) -> None:
        """One more channel."""
        self._missing.discard(scan.channel)
        if not self._missing:
            return
        self._others[scan.channel] = None
        self._times.add(scan.time_ns)
        if len(self._times) >= ENOUGH:
            missing, there = " and ".join(sorted(self._missing)), ", ".join(self._others)
            self._log.error(
                "the scans have no channel %s, so nothing is judged. There are %s: set which", missing, there
            )
            self._missing.clear()
