"""The Nanonis translator as a real process, an emulated controller beside it, and a peer on its sockets."""

from __future__ import annotations

from collections.abc import Mapping
from threading import Event
from typing import Any

from vendor_bench import AtPanel, VendorBench

from afspm.emulators.nanonis import NanonisEmulator


class Emulated(AtPanel, NanonisEmulator):
    """With somebody at its panel, who sees when a scan has ended."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.scan_ended = Event()

    def tick(self, now_s: float) -> float | None:
        next_s = super().tick(now_s)
        if self.panel.ends:
            self.scan_ended.set()
        return next_s


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.microscopes.nanonis.Nanonis"
    data_name = "session"
    settings: Mapping[str, Any] = {"reply_timeout_s": 3.0}
