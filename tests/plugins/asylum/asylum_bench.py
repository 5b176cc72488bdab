"""Bench: the Asylum translator as a process, an emulated microscope, and a peer on the translator's sockets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.asylum.emulator import AsylumEmulator


class Emulated(AtPanel, AsylumEmulator):
    """An emulated microscope with a person at its panel."""


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.asylum.Asylum"
    data_name = "data of the day"
    settings: Mapping[str, Any] = {**PATIENT, "poll_period_s": 0.1}
