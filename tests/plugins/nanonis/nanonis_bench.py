"""The Nanonis translator as a real process, an emulated controller beside it, and a peer on its sockets."""

from __future__ import annotations

from collections.abc import Mapping
from threading import Event
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.nanonis.emulator import NanonisEmulator, PendingReply


class Emulated(AtPanel, NanonisEmulator):
    """With somebody at its panel, who sees when a scan has ended.

    Attributes:
        ends_as_awaited: a scan is over as soon as a client waits for that, and so never between two of its questions.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.scan_ended = Event()
        self.ends_as_awaited = False

    def tick(self, now_s: float) -> float | None:
        scanning = self.software.scans.running
        if self.ends_as_awaited and scanning is not None and self._waits_for("Scan.WaitEndOfScan"):
            scanning.scan.paused_s = -1e6  # all of it is behind
        next_s = super().tick(now_s)
        if self.software.scans.ends:
            self.scan_ended.set()
        return next_s

    def _waits_for(self, function: str) -> bool:
        """Whether a client does."""
        waiting = [connection.waits_for for connection in self._server.connections]
        return any(isinstance(one, PendingReply) and one.name == function for one in waiting)


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.nanonis.Nanonis"
    data_name = "session"
    settings: Mapping[str, Any] = PATIENT
