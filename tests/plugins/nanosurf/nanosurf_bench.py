"""Bench: the Nanosurf translator as a process, an emulated Studio, and a peer on the translator's sockets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.nanosurf.emulator import NanosurfEmulator


class Emulated(AtPanel, NanosurfEmulator):
    """An emulated Studio with a person at its panel."""


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.nanosurf.Nanosurf"
    data_name = "gallery"
    settings: Mapping[str, Any] = {**PATIENT, "poll_period_s": 0.1}
