"""Bench: the Asylum translator as a process, an emulated microscope, and a peer on the translator's sockets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tests.plugins.vendor_bench import PATIENT, AtPanel, VendorBench

from afspm.plugins.asylum.emulator import AsylumEmulator
from afspm.plugins.asylum.emulator.wire import FunctionCall


class Emulated(AtPanel, AsylumEmulator):
    """An emulated microscope with a person at its panel, that notes the functions it was asked for."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.asked: list[str] = []

    def _called(self, call: FunctionCall, now_s: float) -> bytes:
        self.asked.append(call.name)
        return super()._called(call, now_s)


class Bench(VendorBench[Emulated]):
    emulated = Emulated
    translator = "afspm.plugins.asylum.Asylum"
    data_name = "data of the day"
    settings: Mapping[str, Any] = {**PATIENT, "poll_period_s": 0.1}
