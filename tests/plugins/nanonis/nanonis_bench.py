"""Bench: the Nanonis translator as a process, an emulated controller, and a peer on the translator's sockets."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from threading import Event
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.emulation import ClientConnection
from afspm.plugins.nanonis.emulator import NanonisEmulator, NanonisRequest, PendingReply


class Emulated(AtPanel, NanonisEmulator):
    """An emulated controller with a person at its panel, who can see the end of a scan.

    Attributes:
        asked: functions asked for, by port.
        ends_as_awaited: True ends a scan once a client waits for the end, never between two waits.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.scan_ended = Event()
        self.ends_as_awaited = False
        self.loses = ""  # a function at whose request the connection is cut
        self.asked: dict[int, list[str]] = defaultdict(list)

    def tick(self, now_s: float) -> float | None:
        scanning = self.software.scans.running
        if self.ends_as_awaited and scanning is not None and self._waits_for("Scan.WaitEndOfScan"):
            scanning.scan.paused_s = -1e6  # all of it is behind
        next_s = super().tick(now_s)
        if self.software.scans.ends:
            self.scan_ended.set()
        return next_s

    def _answer(self, connection: ClientConnection, asked: NanonisRequest, *rest: Any) -> None:
        self.asked[connection.socket.getsockname()[1]].append(asked.name)
        if asked.name == self.loses:
            self._server.cut(connection)
        else:
            super()._answer(connection, asked, *rest)

    def _waits_for(self, function: str) -> bool:
        waiting = [connection.waits_for for connection in self._server.connections]
        return any(isinstance(one, PendingReply) and one.name == function for one in waiting)


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.nanonis.Nanonis"
    data_name = "session"
    settings: Mapping[str, Any] = PATIENT
