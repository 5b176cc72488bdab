"""A microscope for simulations: all its state is in its memory, and it has no sample."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from afspm.model import Scan, ScopeState, ScopeStatus, Spectrum, names
from afspm.simulation import simulator
from afspm.translator import setting_groups
from afspm.translator.driver import Driver
from afspm.translator.driver_base import action
from afspm.translator.parameters import Value

CHANNELS = ("Height", "Phase")
_KEPT = 16
_AT_FIRST: dict[str, Value] = {
    names.SCAN_TOP_LEFT_X: 0.0,
    names.SCAN_TOP_LEFT_Y: 0.0,
    names.SCAN_SIZE_X: 1e-6,
    names.SCAN_SIZE_Y: 1e-6,
    names.SCAN_ANGLE: 0.0,
    names.SCAN_RESOLUTION_X: 4,
    names.SCAN_RESOLUTION_Y: 4,
}


class BenchMicroscope(Driver):
    """Scans of 4 x 4 pixels, each with the settings it was taken with; no state outside its memory.

    Args:
        scan_s: how long (experiment) a scan takes.
        finished: records each complete scan by its place, over all restarts.
    """

    parameters_file = Path(simulator.__file__).with_name("parameters.toml")
    simulated: ClassVar[bool] = True
    memory_is_all: ClassVar[bool] = True

    def __init__(self, scan_s: float, finished: dict[int, tuple[float, float]]) -> None:
        super().__init__(poll_period_s=1e6)
        self.table = self.table.without([name for name in self.table if name not in _AT_FIRST])
        self._scan_s = scan_s
        self._finished = finished

    def connect(self) -> None:
        for key, value in (("values", dict(_AT_FIRST)), ("doing", None), ("finished", []), ("count", 0)):
            self.memory.setdefault(key, value)

    def status(self) -> ScopeStatus:
        doing = self.memory["doing"]
        if doing is not None and self.clock.now_s() >= doing["end_s"]:
            self.memory["count"] += 1
            values = self.memory["values"]
            self._finished[self.memory["count"]] = (values[names.SCAN_TOP_LEFT_X], values[names.SCAN_TOP_LEFT_Y])
            self.memory["finished"].append([self.memory["count"], dict(self.memory["values"]), doing["end_s"]])
            self.memory["doing"] = doing = None
            del self.memory["finished"][:-_KEPT]
        return ScopeStatus(ScopeState.FREE if doing is None else ScopeState.SCANNING)

    def next_change_s(self) -> float | None:
        doing = self.memory["doing"]
        return None if doing is None else float(doing["end_s"])

    def get(self, vendor: str) -> Value:
        raise NotImplementedError

    def set(self, values: Mapping[str, Value]) -> None:
        raise NotImplementedError

    def read(self, wanted: Collection[str]) -> dict[str, Value]:
        return {name: value for name, value in self.memory["values"].items() if name in wanted}

    def write(self, values: Mapping[str, Value]) -> None:
        self.memory["values"].update(values)

    def results(self) -> Sequence[str]:
        return [f"scan-{number}" for number, _, _ in self.memory["finished"]]

    def load(self, result: str) -> Sequence[Scan | Spectrum]:
        values: dict[str, Any]
        values, end_s = next((v, s) for number, v, s in self.memory["finished"] if f"scan-{number}" == result)
        region, shape = setting_groups.frame(values)
        return [Scan(region, channel, "m", np.zeros(shape), round(end_s * 1e9), result) for channel in CHANNELS]

    @action(names.START_SCAN)
    def start_scan(self) -> None:
        self.memory["doing"] = {"end_s": self.clock.now_s() + self._scan_s}

    @action(names.STOP_SCAN)
    def stop_scan(self) -> None:
        self.memory["doing"] = None

    @action(names.PULSE)
    def pulse(self) -> None:
        self.memory["pulses"] = self.memory.get("pulses", 0) + 1
