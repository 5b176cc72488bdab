"""Recorded nights of small components, some with a hazard planted."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
import zmq

from afspm import Component, Scan
from afspm.components.planned_scans import ScanSeries
from afspm.record.journal import SCHEDULER
from afspm.record.store import RecordStore
from afspm.testing import Bench

OUTSIDE = "AFSPM_TEST_OUTSIDE"
"""Environment variable with the file that `OutsideFile` reads."""
DEVICE = "AFSPM_TEST_DEVICE"
"""Environment variable with the device that `Outsider` writes to."""
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


class Counting(Component):
    """Counts the scans, and writes a note only at the first scan after a kill."""

    def __init__(self) -> None:
        self.says_nothing = False

    def on_scan(self, scan: Scan) -> None:
        if scan.channel == CHANNEL:
            before = self.memory.get("scans", 0)
            self.memory["scans"] = self.counted(before)
            if before and not self.says_nothing:
                self.scope.note(f"{self.memory['scans']} scans")
            self.says_nothing = True

    def counted(self, before: int) -> int:
        return before + 1


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


class Patient(Component):
    """Flags the tip after some ticks, between two packets."""

    period_s = 10.0
    listens = ("ControlState",)

    def __init__(self, ticks: int = 110) -> None:
        self.ticks = ticks

    def on_tick(self) -> None:
        self.memory["ticks"] = self.memory.get("ticks", 0) + 1
        if self.memory["ticks"] == self.ticks:
            self.scope.flag("tip-shape-changed")


class Settling(Remarks):
    """Waits after each scan for a time, instead of for an event."""

    def __init__(self, settle_s: float = 0.0) -> None:
        self.settle_s = settle_s

    def remark(self, scan: Scan) -> str:
        until_s = self.clock.monotonic_s() + self.settle_s
        while self.clock.monotonic_s() < until_s:
            pass
        return "settled"


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


class ProcessNumber(Remarks):
    def remark(self, scan: Scan) -> str:
        return str(os.getpid())


class OutsideFile(Remarks):
    def remark(self, scan: Scan) -> str:
        return Path(os.environ[OUTSIDE]).read_text()


class Writer(Remarks):
    """Appends to a file outside the run."""

    def remark(self, scan: Scan) -> str:
        with Path(os.environ[OUTSIDE]).open("a") as file:
            file.write("x")
        return "written"


class Outsider(Remarks):
    """Changes something outside the run, in a given way."""

    def __init__(self, way: str = "") -> None:
        self.way = way

    def remark(self, scan: Scan) -> str:
        getattr(self, self.way)(Path(os.environ[OUTSIDE]))
        return "done"

    def thread(self, outside: Path) -> None:
        thread = threading.Thread(target=lambda: outside.write_text("by a thread"))
        thread.start()
        thread.join()

    def pool(self, outside: Path) -> None:
        with ThreadPoolExecutor(1) as pool:  # no line of the component is at work in the thread
            pool.submit(shutil.copy, __file__, outside)

    def program(self, outside: Path) -> None:
        command = [sys.executable, "-c", f"open({str(outside)!r}, 'w').write('by a program')"]
        thread = threading.Thread(target=subprocess.run, args=(command,))
        thread.start()
        thread.join()

    def move(self, outside: Path) -> None:
        descriptor, name = tempfile.mkstemp()
        os.close(descriptor)
        Path(name).replace(outside)

    def hdf5(self, outside: Path) -> None:
        h5py.File(outside, "w").close()

    def sqlite(self, outside: Path) -> None:
        outside.unlink(missing_ok=True)
        sqlite3.connect(outside).execute("CREATE TABLE scans (time)").connection.close()

    def device(self, outside: Path) -> None:
        with Path(os.environ[DEVICE]).open("wb", buffering=0) as line:
            line.write(b"PULSE")

    def socket(self, outside: Path) -> None:
        with zmq.Context() as context, context.socket(zmq.PUSH) as push:
            push.bind(f"ipc://{outside}" if zmq.has("ipc") else "tcp://127.0.0.1:*")


class Tidy(Remarks):
    """Uses temporary files, and shows an error with its line."""

    def remark(self, scan: Scan) -> str:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "one.txt").write_text("one")
        other = Path(tempfile.mkdtemp())
        (other / "two.txt").write_text("two")
        shutil.rmtree(other)
        try:
            raise KeyError
        except KeyError:
            return traceback.format_exc()[:100]


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
