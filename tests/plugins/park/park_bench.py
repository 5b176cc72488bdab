"""The Park translator as a real process, an emulated SmartScan beside it, and a peer on the translator's sockets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.park.emulator import ParkEmulator


class Emulated(AtPanel, ParkEmulator):
    """With somebody at its panel."""


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.park.Park"
    data_name = "data"
    settings: Mapping[str, Any] = {**PATIENT, "poll_period_s": 0.1}
