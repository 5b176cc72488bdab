"""`python -m benchmarks.imports`: what the start of each process and command costs, and what an idle run costs then.

Modules, memory and processor time of the processes of a run, beside the bare interpreter with numpy and pyzmq; the same
of commands; and the times a second that each process wakes up while nothing happens. Counts don't depend on other load;
processor time does a little, through caches. Linux alone has the files that are read.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from threading import Event
from typing import TypeVar

from benchmarks.experiment import DEADLINE_S, LARGEST_SAMPLE, ROOT, SETTLING_S, cpu_s, running

T = TypeVar("T")

IDLE_S = 20.0
BARE = "import numpy, zmq"
COMMANDS = (("--help",), ("check", LARGEST_SAMPLE), ("status",))
# Python imports a module of this name in every process: modules are counted at a signal, or at the end of a command
COUNTING = """
import atexit, os, signal, sys

def count(*_):
    with open("/proc/self/status") as status, open(f"{os.environ['COUNTS']}/{os.getpid()}", "w") as file:
        resident = next(line.split()[1] for line in status if line.startswith("VmRSS"))
        print(len(sys.modules), resident, sum(os.times()[:2]), file=file)

signal.signal(signal.SIGUSR1, count)
atexit.register(count)
"""


def main() -> None:
    print(f"{'':44} {'modules':>8} {'memory':>10} {'processor':>10}")
    with _counting() as folder:
        print(_line("bare interpreter with numpy and pyzmq", _command(folder, [sys.executable, "-c", BARE])))
        for command in COMMANDS:
            counts = _command(folder, [sys.executable, "-m", "afspm", *command])
            print(_line(f"afspm {command[0]}", counts))
        with running() as run:
            run.wait_for(r"watcher .*knows the state")
            pids = {"supervisor": run.process.pid, **run.pids}
            Event().wait(SETTLING_S)  # the last of them are still starting
            for name, pid in pids.items():
                os.kill(pid, signal.SIGUSR1)
                print(_line(name, _until(partial(_counts, folder, pid))))
            before, cpu_before_s = {name: _wakeups(pid) for name, pid in pids.items()}, cpu_s([*pids.values()])
            Event().wait(IDLE_S)
            after, took_s = {name: _wakeups(pid) for name, pid in pids.items()}, cpu_s([*pids.values()]) - cpu_before_s
    print("\nwake-ups a second while idle: " + ", ".join(_rates(before, after)))
    print(f"processor while idle: {100.0 * took_s / IDLE_S:.2g} % of a core")


@contextmanager
def _counting() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        (folder / "sitecustomize.py").write_text(COUNTING, encoding="utf-8")
        os.environ.update(PYTHONPATH=text, COUNTS=text)
        yield folder


def _command(folder: Path, command: list[str]) -> list[str]:
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        process.wait()  # with an error, too: `status` has no run
    return _until(partial(_counts, folder, process.pid))


def _counts(folder: Path, pid: int) -> list[str]:
    file = folder / str(pid)
    return file.read_text(encoding="utf-8").split() if file.exists() else []


def _until(found: Callable[[], T]) -> T:
    for _ in range(round(DEADLINE_S * 20)):
        if result := found():
            return result
        Event().wait(0.05)
    raise TimeoutError("a process did not count its modules")


def _line(name: str, counts: list[str]) -> str:
    modules, kilobytes, processor_s = counts
    return f"{name:44} {modules:>8} {float(kilobytes) / 1024.0:>7.0f} MB {float(processor_s):>8.2f} s"


def _wakeups(pid: int) -> int:
    # of all threads that wait, those of libzmq too
    counts = [0]
    for task in Path(f"/proc/{pid}/task").iterdir():
        if found := re.search(r"^voluntary_ctxt_switches:\s+(\d+)", (task / "status").read_text(), re.MULTILINE):
            counts.append(int(found[1]))
    return sum(counts)


def _rates(before: Mapping[str, int], after: Mapping[str, int]) -> Iterator[str]:
    yield from (f"{name} {(after[name] - before[name]) / IDLE_S:.0f}" for name in after)


if __name__ == "__main__":
    main()
