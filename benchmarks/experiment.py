"""A whole experiment: times of start, restart after a kill, and end, and its cost while idle."""

from __future__ import annotations

import contextlib
import os
import queue
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import zmq

import afspm
from afspm.basics.errors import RequestError
from benchmarks.effort import effort
from benchmarks.rows import NotMeasured, Row, measurement

DEADLINE_S = 30.0
STARTS = KILLS = ENDS = effort(5, 1)
IDLE_S = effort(10.0, 0.2)
SETTLING_S = effort(3.0, 0.0)
ROOT = Path(__file__).resolve().parents[1]
LARGEST_SAMPLE = "experiments/paper_form/experiment.toml"

# six processes, none of which has anything to do
EXPERIMENT = """
[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "{address}"

[tip_classifier]
component = true
class = "TipClassifier"

[tip_corrector]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
test_center = ["0 um", "4 um"]

[metadata]
component = true
class = "Metadata"

[watcher]
component = true
class = "watcher.Watcher"
"""
WATCHER = """
from afspm.client.component import Component


class Watcher(Component):
    def on_state(self, status):
        self.log.info("knows the state")
"""


class Running:
    """`afspm run` of the experiment above."""

    def __init__(self, folder: Path) -> None:
        # over TCP every socket has keys, which a bare subscriber lacks
        self.address = f"ipc://{folder}/publications"
        self.runs = folder / "runs"
        self.file = folder / "experiment.toml"
        self.file.write_text(EXPERIMENT.format(address=self.address), encoding="utf-8")
        (folder / "watcher.py").write_text(WATCHER, encoding="utf-8")
        command = [sys.executable, "-c", "from afspm.cli import main; main()"]
        self.process = subprocess.Popen(
            [*command, "run", str(self.file), "--runs", str(self.runs), "--verbose"],
            stdout=subprocess.PIPE,
            text=True,
        )
        self.pids: dict[str, int] = {}
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(line)

    def wait_for(self, pattern: str) -> None:
        """Wait for a line of the log, from the end of the last wait."""
        while True:
            line = self._lines.get(timeout=DEADLINE_S)
            if started := re.search(r"(\w+) +started, process (\d+)", line):
                self.pids[started[1]] = int(started[2])
            if re.search(pattern, line):
                return

    def close(self) -> None:
        self.process.terminate()
        self.process.wait()


@contextlib.contextmanager
def running() -> Iterator[Running]:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        run = Running(Path(folder))
        try:
            yield run
        finally:
            run.close()


def _needs_signals() -> None:
    if sys.platform == "win32":
        raise NotMeasured("Windows has no signals that kill or freeze a process")


@measurement
def start_up() -> Iterator[Row]:
    _needs_signals()
    yield Row("afspm run to the first ScopeState", "s", statistics.median(map(_start_s, range(STARTS))), None, 1.8)


def _start_s(_: int) -> float:
    context = zmq.Context()
    subscriber = context.socket(zmq.SUB)
    subscriber.subscribe(b"ScopeStateMsg")
    subscriber.setsockopt(zmq.RECONNECT_IVL, 10)
    try:
        began_s = perf_counter()
        with running() as run:
            subscriber.connect(run.address)
            if not subscriber.poll(round(DEADLINE_S * 1000)):
                raise TimeoutError("no ScopeState came")
            return perf_counter() - began_s
    finally:
        context.destroy(linger=0)


@measurement
def commands() -> Iterator[Row]:
    for command, target_s in ((("--help",), 0.3), (("check", LARGEST_SAMPLE), 1.0), (("status", "."), 0.5)):
        took_s = statistics.median(_command_s(command) for _ in range(STARTS))
        yield Row(f"afspm {command[0]}", "s", took_s, None, target_s)


def _command_s(command: Sequence[str]) -> float:
    began_s = perf_counter()
    # without a run `status` ends with 3, after all its imports
    subprocess.run([sys.executable, "-m", "afspm", *command], cwd=ROOT, capture_output=True, check=False)
    return perf_counter() - began_s


@measurement
def recovery() -> Iterator[Row]:
    _needs_signals()
    with running() as run:
        run.wait_for(r"watcher .*knows the state")
        took_s = [_component_back_s(run) for _ in range(KILLS)]
        yield Row("kill -9 a component until it has the cache again", "s", statistics.median(took_s), None, 1.0)
    for name in ("microscope", "scheduler"):
        took_s = [_back_s(name) for _ in range(KILLS)]
        role = "translator" if name == "microscope" else name
        yield Row(f"kill -9 the {role} until a request is served", "s", statistics.median(took_s), None, 1.5)


def _component_back_s(run: Running) -> float:
    began_s = perf_counter()
    os.kill(run.pids["watcher"], signal.SIGKILL)
    run.wait_for(r"watcher .*killed by SIGKILL")  # lines from before its death are no sign of life
    run.wait_for(r"watcher .*started, process")
    run.wait_for(r"watcher .*knows the state")
    return perf_counter() - began_s


def _back_s(name: str) -> float:
    # from the kill until the component in control has an answer of the microscope again
    with running() as run:
        run.wait_for(r"watcher .*knows the state")
        scope = afspm.connect(run.runs, name="benchmark")
        with scope.control():
            scope.get("scan-speed")
            began_s = perf_counter()
            os.kill(run.pids[name], signal.SIGKILL)
            run.wait_for(rf"{name} .*killed by SIGKILL")
            deadline_s = began_s + DEADLINE_S
            while perf_counter() < deadline_s:
                with contextlib.suppress(RequestError):
                    scope.get("scan-speed")
                    return perf_counter() - began_s
    raise TimeoutError(f"{name} did not come back")


@measurement
def ending() -> Iterator[Row]:
    _needs_signals()
    took_s = [_end_s(deaf=False) for _ in range(ENDS)]
    yield Row("Ctrl-C until all has ended", "s", statistics.median(took_s), None, 2.0)
    took_s = [_end_s(deaf=True) for _ in range(ENDS)]
    yield Row("Ctrl-C until all has ended, one being frozen", "s", statistics.median(took_s), None, 2.0)


def _end_s(*, deaf: bool) -> float:
    with running() as run:
        run.wait_for(r"watcher .*knows the state")
        if deaf:
            os.kill(run.pids["watcher"], signal.SIGSTOP)
        began_s = perf_counter()
        run.process.send_signal(signal.SIGINT)
        run.process.wait(DEADLINE_S)
        return perf_counter() - began_s


@measurement
def idle() -> Iterator[Row]:
    if not Path("/proc/self/stat").exists():
        raise NotMeasured("the processor time of other processes is read from /proc, which Linux alone has")
    with running() as run:
        run.wait_for(r"watcher .*knows the state")
        pids = [run.process.pid, *run.pids.values()]
        # the last of them are still starting: what they do in the first seconds is not idling
        threading.Event().wait(SETTLING_S)
        began_s, before_s = perf_counter(), cpu_s(pids)
        threading.Event().wait(IDLE_S)
        percent = 100.0 * (cpu_s(pids) - before_s) / (perf_counter() - began_s)
    yield Row(f"idle: {len(pids) - 1} processes and their supervisor", "% of a core", percent, None, 1.0)


def cpu_s(pids: list[int]) -> float:
    """Return the user and system time of processes so far."""
    ticks = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")
