"""What a user waits for between two measurements: afspm beside a plain script with the maker's Python client.

Both measure at an emulated Nanonis in real time, one after the other. The script does what a careful user would write:
settings, start, wait, read all channels, save. afspm runs as a whole: supervisor, scheduler, translator, recorder and a
ready-made component. A period is the time from the end of one measurement to the end of the next.

On a real controller a question takes longer than at an emulated one, so the questions from the end of a measurement to
the start of the next are counted, too. They do not depend on the speed of the computer.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import socket
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

import afspm
from afspm.translator.trace import FILE, TracedExchange, trace_lines
from benchmarks.effort import effort
from benchmarks.processes import roles
from benchmarks.rows import Row, measurement

ROWS, WIDTH_M = 32, 1e-6
FRAME_M = WIDTH_M * ROWS / (ROWS - 1)
"""The same region as Nanonis counts it: to the edges of its outer pixels, not to their centres."""
FRAMES, FRAME_S = effort(20, 3), effort(1.28, 0.32)
SHORT_FRAMES, SHORT_FRAME_S = effort(100, 3), 0.32
LONG_FRAMES, LONG_FRAME_S = effort(4, 2), effort(10.0, 0.32)
CURVES = effort(12, 3)
MORE_THAN_THE_SCRIPT_MS = 20.0
PROVES_A_CURVE_MS = 10.0
"""For the questions that show tip, feedback and values at the end of a curve and before the next."""
COUNTED = 4
"""Measurements whose questions are counted."""
AS_MANY = 3.0
"""Times the questions of a plain script: seven a scan prove that its frame, feedback and values are those claimed."""
QUESTIONS_OF_A_CURVE = 18
"""A script asks one: its start. Seven more look at the end, seven before the start, whether a person has withdrawn the
tip, measures or approaches."""
LONGEST_PART = 1.005
"""Of the time of a script, for scans that take as long as scans do."""
DEADLINE_S = 300.0
_ON, _UP, _START = 1, 1, 0

EXPERIMENT = """
[controller]
component = true
class = "NanonisEmulator"
surface = "particles"
feedback = {{ mode = "amplitude" }}
seed = 7

[microscope]
component = true
class = "Nanonis"
trace = {trace}

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
end_when_done = true
{component}
"""
SCANS = """
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [{rows}, {rows}]
scans = {count}
parameters = {{ scan-speed = {speed} }}
"""
SPECTRA = """
class = "SpectroscopyGrid"
positions = [["0 nm", "0 nm"]]
kind = "IV"
repeats = {count}
"""


def speed_m_s(frame_s: float) -> float:
    return 2.0 * FRAME_M * ROWS / frame_s


@contextlib.contextmanager
def ended_run(component: str, *, trace: bool = False) -> Iterator[Path]:
    """Run an experiment to its end, and yield the folder with its run."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        file = Path(folder) / "experiment.toml"
        file.write_text(EXPERIMENT.format(component=component, trace=str(trace).lower()), encoding="utf-8")
        command = [sys.executable, "-c", "from afspm.cli import main; main()", "run", str(file)]
        run = subprocess.run(
            [*command, "--runs", folder, "--no-report"],
            capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False, env=os.environ,
        )  # fmt: skip
        if run.returncode:
            raise RuntimeError(run.stdout + run.stderr)
        yield Path(folder)


def afspm_periods_s(component: str, table: str) -> list[float]:
    """Run an experiment to its end, and return its periods as the record has them."""
    with ended_run(component) as folder, afspm.open_run(folder) as record:
        ends_s = [row.time_ns * 1e-9 for row in getattr(record, table)]
    return [after - before for before, after in itertools.pairwise(ends_s)]


def afspm_questions(component: str, started_by: str, ended_by: str) -> float:
    """Return the questions from the reported end of a measurement to the start of the next one, the start included.

    Args:
        started_by, ended_by: functions of Nanonis: one starts a measurement, one replies at its end.
    """
    with ended_run(component, trace=True) as folder:
        lines = list(trace_lines(next(folder.glob(f"*/{FILE}"))))
    asked = sorted((one for one in lines if isinstance(one, TracedExchange)), key=lambda one: one.at_s)
    starts_s = [one.at_s for one in asked if one.what == started_by]
    counts = []
    for before_s, start_s in itertools.pairwise(starts_s):
        ends_s = [one.at_s + one.took_s for one in asked if one.what == ended_by]
        end_s = max((at_s for at_s in ends_s if before_s < at_s < start_s), default=start_s)
        counts.append(sum(end_s <= one.at_s <= start_s for one in asked))
    return statistics.median(counts)


class Script:
    """A plain script with the maker's client. Its functions return (error, raw reply, values)."""

    def __init__(self, client: Any, folder: Path) -> None:
        self._client, self._folder = client, folder
        self.questions = 0

    def ask(self, function: str, *arguments: Any) -> list[Any]:
        self.questions += 1
        error, _, values = getattr(self._client, function)(*arguments)
        if error:
            raise RuntimeError(f"{function}: {error}")
        return list(values)

    def scans(self, count: int, frame_s: float) -> list[float]:
        speed, line_s, same = speed_m_s(frame_s), frame_s / (2 * ROWS), 0
        channels = [int(np.ravel(channel)[0]) for channel in self.ask("Scan_BufferGet")[1]]
        ends_s = []
        for number in range(count):
            self.ask("Scan_FrameSet", 0.0, 0.0, FRAME_M, FRAME_M, 0.0)
            self.ask("Scan_BufferSet", channels, ROWS, ROWS)
            self.ask("Scan_SpeedSet", speed, speed, line_s, line_s, _ON, 1.0)
            self.ask("Scan_Action", _START, _UP)
            self.ask("Scan_WaitEndOfScan", -1)
            ends_s.append(perf_counter())
            images = [self.ask("Scan_FrameDataGrab", channel, way) for channel in channels for way in (_ON, same)]
            with (self._folder / f"scan-{number}.npz").open("wb") as file:
                np.savez(file, *(np.asarray(image[-2]) for image in images))
        return [after - before for before, after in itertools.pairwise(ends_s)]

    def curves(self, count: int) -> list[float]:
        self.ask("BiasSpectr_Open")
        ends_s = []
        for number in range(count):
            values = self.ask("BiasSpectr_Start", 1, "curve")
            ends_s.append(perf_counter())
            with (self._folder / f"curve-{number}.npz").open("wb") as file:
                np.savez(file, np.asarray(values[-3]))
        return [after - before for before, after in itertools.pairwise(ends_s)]


@contextlib.contextmanager
def script() -> Iterator[Script]:
    """A script that is connected to an emulated controller in another process."""
    from nanonis_spm import Nanonis

    with tempfile.TemporaryDirectory() as folder, roles() as processes:
        address = processes.start("emulator", vendor="nanonis", folder=folder)
        host, _, ports = str(address).partition(":")
        with socket.create_connection((host, int(ports.split(",")[0])), timeout=60.0) as connection:
            yield Script(Nanonis(connection), Path(folder))


def _period(what: str, ours_s: list[float], bare_s: list[float], more_ms: float = MORE_THAN_THE_SCRIPT_MS) -> Row:
    bare_ms = statistics.median(bare_s) * 1e3
    target = 1.0 + more_ms / bare_ms
    return Row(f"{what}: a period beside a script's", "ms", statistics.median(ours_s) * 1e3, bare_ms, target)


def _scans(count: int, frame_s: float) -> tuple[list[float], list[float]]:
    ours_s = afspm_periods_s(SCANS.format(rows=ROWS, count=count, speed=speed_m_s(frame_s)), "scans")
    with script() as plain:
        return ours_s, plain.scans(count, frame_s)


@measurement
def dead_time() -> Iterator[Row]:
    what = f"scans of {FRAME_S:g} s"
    yield _period(what, *_scans(FRAMES, FRAME_S))
    what = f"{SHORT_FRAMES} scans of {SHORT_FRAME_S:g} s"
    ours_s, bare_s = _scans(SHORT_FRAMES, SHORT_FRAME_S)
    yield _period(what, ours_s, bare_s)
    yield Row(
        f"{what}, all of them", "s", sum(ours_s), sum(bare_s), 1.0 + MORE_THAN_THE_SCRIPT_MS / 1e3 / SHORT_FRAME_S
    )
    ours_s, bare_s = _scans(LONG_FRAMES, LONG_FRAME_S)
    medians_s = statistics.median(ours_s), statistics.median(bare_s)
    yield Row(f"a scan of {LONG_FRAME_S:g} s, from end to end", "s", *medians_s, LONGEST_PART)
    scans = SCANS.format(rows=ROWS, count=COUNTED, speed=speed_m_s(SHORT_FRAME_S))
    ours = afspm_questions(scans, "Scan.Action", "Scan.WaitEndOfScan")
    with script() as plain:
        plain.scans(COUNTED, SHORT_FRAME_S)
        # of each scan all but the wait for its end; and the question for the channels
        bare = (plain.questions - 1) / COUNTED - 1
    yield Row("questions from the end of a scan to the next start", "", ours, bare, AS_MANY)


@measurement
def dead_time_of_curves() -> Iterator[Row]:
    ours_s = afspm_periods_s(SPECTRA.format(count=CURVES), "spectra")
    with script() as plain:
        yield _period("curves", ours_s, plain.curves(CURVES), MORE_THAN_THE_SCRIPT_MS + PROVES_A_CURVE_MS)
    ours = afspm_questions(SPECTRA.format(count=COUNTED), "BiasSpectr.Start", "BiasSpectr.Start")
    yield Row("questions from the end of a curve to the next start", "", ours, None, QUESTIONS_OF_A_CURVE)
