"""Bench: the Park translator as a process, an emulated SmartScan, and a peer on the translator's sockets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.park.emulator import ParkEmulator


class Emulated(AtPanel, ParkEmulator):
    """An emulated SmartScan with a person at its panel."""


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.park.Park"
    data_name = "data"
    settings: Mapping[str, Any] = {**PATIENT, "poll_period_s": 0.1}
