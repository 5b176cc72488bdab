"""`python -m benchmarks.shadow_evenings [evening] [load] [MAKER …]`: a shadow beside a person at emulated controllers.

A person takes 14 scans of one place; the tip becomes double in the eighth, and the person stops scans 9, 11 and 13.
Printed is what the shadow reported of them, and its questions a second while nothing happens and during a scan, both
in real time. The files of the runs stay in build/evenings.

The person is a part of the emulator, and so in the same clock as the shadow. The rates are taken with a clock in real
time, from the trace.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from threading import Event
from typing import Any

from afspm.basics.clock import NS_PER_S
from afspm.basics.formatting import counted
from afspm.plugins.asylum.emulator import AsylumEmulator
from afspm.plugins.gxsm.emulator import GxsmEmulator
from afspm.plugins.nanonis.emulator import NanonisEmulator
from afspm.plugins.nanosurf.emulator import NanosurfEmulator
from afspm.plugins.nanosurf.emulator.studio import StudioProgram
from afspm.plugins.park.emulator import ParkEmulator
from afspm.plugins.park.emulator.smartscan import SmartScanProgram
from afspm.report.shadow import FILE, ShadowKind
from afspm.simulation.emulation.emulator import Emulator
from afspm.translator.trace import FILE as TRACE
from afspm.translator.trace import TracedExchange, TraceHeader, trace_lines
from benchmarks.crashes import CrashWatch
from benchmarks.effort import effort
from benchmarks.experiment import ROOT

SCANS = effort(14, 6)
CHANGED, STOPPED = effort(8, 3), effort((9, 11, 13), (4,))
"""The scan in which the tip changes, and the scans that the person stops."""
LINES, LINE_S = 64, 0.5
AFTER_A_STOP_S, AFTER_A_SCAN_S = 15.0, 40.0
SPEED = 20.0
IDLE_S, SCAN_LINE_S = effort(60.0, 5.0), effort(1.0, 0.1)
"""Of the load: the time without a scan before and after, and the time of a line of the scan between them."""
LOOKS_S = 0.5
FOLDER = Path("build/evenings")
ACTS = "person.jsonl"

EXPERIMENT = """
[clock]
speed = {speed}

[controller]
component = true
class = "benchmarks.shadow_evenings.{person}"
surface = "particles"
seed = 7
drift = {{ velocity_m_per_s = [5e-11, -3e-11, 0.0] }}
plan = "{plan}"
{emulator}

[microscope]
reply_timeout_s = "60 s" # an emulator draws scans: on a busy computer its answers come late
{microscope}

[limits.tip-bias-voltage]
max = "2 V"
"""


class AtTheController(Emulator):
    """An emulated controller with a person, who writes each act into a file."""

    def __init__(self, *, plan: str = "evening", **settings: Any) -> None:
        super().__init__(**settings)
        self._plan: Iterator[float] = {"evening": self._evening, "load": self._load}[plan]()
        self._due_s = 0.0

    def set_up(self, line_s: float) -> None:
        """Set the frame's pixels, and the time of a line with both directions."""
        raise NotImplementedError

    def start(self) -> None:
        raise NotImplementedError

    def stop_the_scan(self) -> None:
        raise NotImplementedError

    def turn(self, volts: float) -> None:
        """Set the bias, or a setpoint where no bias can be set."""
        raise NotImplementedError

    def tick(self, now_s: float) -> float | None:
        next_s = super().tick(now_s)
        self._due_s = self._due_s or now_s
        while self._due_s <= now_s:
            self._due_s = now_s + next(self._plan)
        return self._due_s if next_s is None else min(next_s, self._due_s)

    def _did(self, act: str, **facts: object) -> None:
        with (self.folder / ACTS).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"time_s": self.clock.now_s(), "act": act, **facts}) + "\n")

    def _begun(self) -> Iterator[float]:
        before = self.rig.scan
        self.start()
        while self.rig.scan is before:  # some begin only after a ramp
            yield 0.1

    def _ended(self) -> Iterator[float]:
        while self.rig.doing(self.clock.now_s()) == "scan":
            yield 0.2

    def _evening(self) -> Iterator[float]:
        yield 120.0
        self.set_up(LINE_S)
        yield 60.0
        for number in range(1, SCANS + 1):
            scan_s = LINES * LINE_S
            if number == CHANGED - 1:
                self.turn(2.5)
                self._did("turn")
                yield AFTER_A_STOP_S
            self._did("start", number=number)
            yield from self._begun()
            if number in STOPPED:
                yield 0.6 * scan_s
                self.stop_the_scan()
                self._did("stop", number=number)
                yield AFTER_A_STOP_S
            else:
                if number == CHANGED:
                    yield 0.4 * scan_s
                    self.rig.change_tip("double", self.clock.now_s())
                    self._did("tip", condition="double")
                yield from self._ended()
                self._did("end", number=number)
                yield AFTER_A_SCAN_S
        yield from self._home()

    def _load(self) -> Iterator[float]:
        yield 10.0
        self.set_up(SCAN_LINE_S)
        yield 5.0
        self._did("idle")
        yield IDLE_S
        self._did("start")
        yield from self._begun()
        yield from self._ended()
        self._did("end")
        yield IDLE_S / 4
        yield from self._home()

    def _home(self) -> Iterator[float]:
        self._did("home")
        yield from itertools.repeat(3600.0)


class AtNanonis(AtTheController, NanonisEmulator):
    """A person at an emulated Nanonis."""

    def set_up(self, line_s: float) -> None:
        self._call("Scan.BufferSet", [], LINES, LINES)
        self._call("Scan.SpeedSet", 1e-6, 1e-6, line_s / 2, line_s / 2, 2, 1.0)

    def start(self) -> None:
        self.software.scans.start(upwards=True)

    def stop_the_scan(self) -> None:
        self._call("Scan.Action", 1, 0)

    def turn(self, volts: float) -> None:
        self._call("Bias.Set", volts)

    def _call(self, name: str, *arguments: object) -> None:
        self.software.functions.call(name, list(arguments))


class AtAsylum(AtTheController, AsylumEmulator):
    """A person at an emulated Asylum, whose Stop withdraws the tip, and whose Start engages again."""

    def set_up(self, line_s: float) -> None:
        for name, value in (("PointsLines;ScanPoints;ScanLines", LINES), ("ScanRate", 1 / line_s), ("LastScan", 1)):
            self.controller.values.put(name, value)

    def start(self) -> None:
        self.controller.values.put("LastScan", 1)  # else one scan follows the other
        self.controller.scan(self.clock.now_s(), None)

    def stop_the_scan(self) -> None:
        self.controller.stop(self.clock.now_s())

    def turn(self, volts: float) -> None:
        self.controller.put("TipVoltage", volts, self.clock.now_s())


class AtGxsm(AtTheController, GxsmEmulator):
    """A person at an emulated GXSM."""

    def set_up(self, line_s: float) -> None:
        for name, value in (("RangeX", 1e4), ("PointsX", LINES), ("dsp-fbs-scan-speed-scan", 2e4 / line_s)):
            self.program.entries.set(name, repr(value))

    def start(self) -> None:
        self.program.start_scan()

    def stop_the_scan(self) -> None:
        self.program.stop_scan()

    def turn(self, volts: float) -> None:
        self.program.entries.set("dsp-fbs-bias", repr(volts))


class AtNanosurf(AtTheController, NanosurfEmulator):
    """A person at an emulated Nanosurf Studio."""

    program: StudioProgram

    def set_up(self, line_s: float) -> None:
        for name, value in (("points_per_line", LINES), ("lines_per_frame", LINES), ("line_rate", 1 / line_s)):
            self.program.put(f"imaging.{name}", value)

    def start(self) -> None:
        self.program.start_scan(self.clock.now_s())

    def stop_the_scan(self) -> None:
        self.program.stop_scan(self.clock.now_s())

    def turn(self, volts: float) -> None:
        self.program.put("z_control.setpoint", volts / 4)


class AtPark(AtTheController, ParkEmulator):
    """A person at an emulated SmartScan."""

    program: SmartScanProgram

    def set_up(self, line_s: float) -> None:
        self.program.ask("call", "scan.setScanGeometry", [{"pixelWidth": LINES, "pixelHeight": LINES}])
        self.program.ask("set", "scan.rate", [1 / line_s])

    def start(self) -> None:
        self.program.start_scan(self.clock.now_s())

    def stop_the_scan(self) -> None:
        self.program.stop_scan(self.clock.now_s())

    def turn(self, volts: float) -> None:
        self.program.ask("set", "bias.tip", [volts])


@dataclass(frozen=True)
class Controller:
    """An emulated controller with a person, and settings in TOML of the emulator and of the shadow's driver."""

    person: type[AtTheController]
    emulator: str = ""
    microscope: str = ""


_AMPLITUDE = 'feedback = { mode = "amplitude" }'
_VOLTS = '[microscope.parameters.zctrl-setpoint]\nunit = "V"'
CONTROLLERS: Mapping[str, Controller] = {
    "nanonis": Controller(AtNanonis, _AMPLITUDE, _VOLTS),
    "gxsm": Controller(AtGxsm),
    "asylum": Controller(AtAsylum),
    "nanosurf": Controller(AtNanosurf, "release = 18", "release = 18"),
    "park": Controller(AtPark),
}


def watched(maker: str, plan: str, speed: float) -> Path:
    """Run a shadow beside a person until the person goes home; return the folder of its run."""
    folder, one = FOLDER / f"{maker}-{plan}", CONTROLLERS[maker]
    folder.mkdir(parents=True)
    file = folder / "evening.toml"
    names = {"person": one.person.__name__, "emulator": one.emulator, "microscope": one.microscope}
    file.write_text(EXPERIMENT.format(speed=speed, plan=plan, **names), encoding="utf-8")
    command = (sys.executable, "-m", "afspm", "shadow", "--on", maker, str(file), "--runs", str(folder))
    watch = CrashWatch()
    with (folder / "output.txt").open("w", encoding="utf-8") as output:
        # the classes of this module are the processes' controllers
        shadow = subprocess.Popen(command, stdout=output, stderr=output, env={**os.environ, "PYTHONPATH": str(ROOT)})
        while shadow.poll() is None and not any(one["act"] == "home" for one in acts(folder)):
            Event().wait(LOOKS_S)
        shadow.send_signal(signal.SIGINT)
        shadow.wait()
    if crashes := watch.in_logs(folder):
        raise RuntimeError(f"a process has crashed: {crashes}")
    return next(file.parent for file in folder.glob("*/shadow.csv"))


def acts(folder: Path) -> list[dict[str, Any]]:
    """Return the acts of the person so far."""
    files = folder.rglob(ACTS)
    return [json.loads(line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]


def judged(maker: str) -> Iterator[str]:
    """Yield what a shadow reported of an evening, beside the truth."""
    run = watched(maker, "evening", SPEED)
    with (run / FILE).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    done = acts(run)
    changed_s = next(one["time_s"] for one in done if one["act"] == "tip")
    before, after = (
        [row for row in rows if (int(row["time_ns"]) / NS_PER_S > changed_s) is is_after] for is_after in (False, True)
    )
    whole = sum(one["act"] == "end" for one in done)
    yield f"{_count(rows, 'scan')} of {whole} whole scans seen"
    for when, some, right, wrong in (("before", before, "gone on", "bad"), ("after", after, "bad", "gone on")):
        counts = [_count(some, "scan", afspm=verdict) for verdict in (right, wrong)]
        yield f"judged right {when} the change: {counts[0]} of {sum(counts)}"
    for kind in (ShadowKind.SCAN, ShadowKind.LINES, ShadowKind.PROBLEM):
        answered = sum(row["kind"] == kind and bool(row["person"]) for row in rows)
        yield f"{kind}: {_count(before, kind)} before the change, {_count(after, kind)} after it; {answered} answered"
    yield f"stops seen: {_count(rows, 'by hand', person='ended before its last line')} of {len(STOPPED)}"


def _count(rows: Iterable[Mapping[str, str]], kind: str, afspm: str = "", person: str = "") -> int:
    return sum(row["kind"] == kind and afspm in row["afspm"] and person in row["person"] for row in rows)


def loads(maker: str) -> Iterator[str]:
    """Yield the questions a second of a shadow."""
    run = watched(maker, "load", 1.0)
    header, *lines = trace_lines(run / TRACE)
    assert isinstance(header, TraceHeader)
    began_s = datetime.fromisoformat(header.began).timestamp()
    asked_s = [(began_s + line.at_s, line.connection) for line in lines if isinstance(line, TracedExchange)]
    idle_s, start_s, end_s = (one["time_s"] for one in acts(run)[:3])
    for what, from_s, to_s in (("nothing happens", idle_s, start_s), ("a scan", start_s, end_s)):
        inside = [(at_s, connection) for at_s, connection in asked_s if from_s <= at_s < to_s]
        seconds, connections = Counter(int(at_s) for at_s, _ in inside), len({one for _, one in inside})
        rate, most = len(inside) / (to_s - from_s), max(seconds.values())
        yield f"{what}: {rate:.0f} questions a second on {counted(connections, 'connection')}, at most {most}"


PLANS = {"evening": judged, "load": loads}

if __name__ == "__main__":
    # a shell that runs this in the background ignores Ctrl-C for it, and so would the shadows that it ends that way
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    chosen = sys.argv[1:]
    for plan, report in PLANS.items():
        for maker in CONTROLLERS:
            if all(one in chosen or not {*chosen} & {*known} for one, known in ((plan, PLANS), (maker, CONTROLLERS))):
                for line in report(maker):
                    print(f"{maker}: {line}", flush=True)
