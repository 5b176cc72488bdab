"""Recorded nights of small components, some with a hazard planted."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np

from afspm import Component, Scan
from afspm.components.planned_scans import ScanSeries
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordStore
from afspm.testing import Bench

OUTSIDE = "AFSPM_TEST_OUTSIDE"
"""Environment variable with the file that `OutsideFile` reads."""
CHANNEL = "Height"


class Series(ScanSeries):
    """Four scans, one every ten minutes."""

    side = 8

    def __init__(self) -> None:
        super().__init__((1e-6, 1e-6), pixels=(self.side, self.side), every=600.0, scans=4)


class FineSeries(Series):
    """Scans that are too large for the log of requests."""

    side = 64


class Remarks(Component):
    """Writes a note about each scan."""

    def on_scan(self, scan: Scan) -> None:
        if scan.channel == CHANNEL:
            self.scope.note(self.remark(scan))

    def remark(self, scan: Scan) -> str:
        raise NotImplementedError


class Judge(Remarks):
    """Calls a scan rough if it is rougher than the mean of all before, by some factor; that survives a kill."""

    def __init__(self, factor: float = 1.0) -> None:
        self.factor = factor

    def remark(self, scan: Scan) -> str:
        seen = self.memory.get("seen", [])
        roughness = float(np.std(scan.values))
        self.memory["seen"] = [*seen, roughness]
        return "rough" if seen and roughness > self.factor * sum(seen) / len(seen) else "smooth"


class Alarmist(Component):
    """Flags the tip at the second scan, and clears it at the next tick."""

    period_s = 60.0

    def __init__(self, at: int = 2) -> None:
        self.at = at

    def on_scan(self, scan: Scan) -> None:
        if scan.channel == CHANNEL:
            self.memory["scans"] = self.memory.get("scans", 0) + 1
            if self.memory["scans"] == self.at:
                self.scope.flag("tip-shape-changed")

    def on_tick(self) -> None:
        if "tip-shape-changed" in map(self.scope.problems.name, self.scope.control_state.problems):
            self.scope.clear("tip-shape-changed")


class WallClock(Remarks):
    def remark(self, scan: Scan) -> str:
        return f"at {time.time_ns()}"


class Unseeded(Remarks):
    def remark(self, scan: Scan) -> str:
        return f"drew {random.random()}"


class UnseededNumpy(Remarks):
    def remark(self, scan: Scan) -> str:
        return f"drew {np.random.default_rng().random()}"


class SharedNumpy(Remarks):
    def remark(self, scan: Scan) -> str:
        return f"drew {np.random.random()}"


class SetOrder(Remarks):
    def remark(self, scan: Scan) -> str:
        return " ".join({f"word{number}" for number in range(30)})


class OutsideFile(Remarks):
    def remark(self, scan: Scan) -> str:
        return Path(os.environ[OUTSIDE]).read_text()


class Writer(Remarks):
    """Appends to a file outside the run."""

    def remark(self, scan: Scan) -> str:
        with Path(os.environ[OUTSIDE]).open("a") as file:
            file.write("x")
        return "written"


class Page(WallClock):
    """A component with inputs beyond its port, as a dashboard has."""

    has_people = True


def record(
    folder: Path,
    others: Mapping[str, Component],
    faults: Callable[[Bench], None] = lambda bench: None,
    *,
    seed: int = 1,
    dies_in_call: float = 0.0,
    until: str = "1 h",
    series: Series | None = None,
) -> Bench:
    """Simulate a night that keeps its requests, and write its record into `folder`."""
    bench = Bench(
        series or Series(), others=others, folder=folder, seed=seed, dies_in_call=dies_in_call, keeps_requests=True
    )
    faults(bench)
    bench.run(until=until)
    with closing(RecordStore(folder)) as store:
        store.take((packet, SCHEDULER) for packet in bench.packets)
        store.finish()
    return bench
