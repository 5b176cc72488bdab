"""Run a command and print the processor time that it took, with all processes that it started.

`make test` runs the tests by it. A clock on the wall says how busy a computer was, processor time how much there was to
do. A second of it is worth less where others use the caches, the memory or the host of a virtual machine: so a short
calibration loop runs before, now and then beside the command, and after it, and its time scales the limit.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from typing import Final

REFERENCE_LOOP_S: Final = 0.050
"""Processor time of the calibration loop on an idle core of the computer where the limit was set (Python 3.11)."""
LIMIT_S: Final = 360.0
"""Processor time that `make test` may take on that computer."""
ROUNDS_AT_EACH_END: Final = 5
SAMPLED_EVERY_S: Final = 10.0
"""So that the loop itself takes half a percent of one core."""
_PR_SET_CHILD_SUBREAPER: Final = 36


@dataclass(frozen=True)
class Cost:
    """Processor time in s of a command with its descendants, and of the calibration loop, at best and meanwhile."""

    user_s: float
    system_s: float
    least_loop_s: float
    loop_s: float

    @property
    def total_s(self) -> float:
        return self.user_s + self.system_s

    @property
    def scaled_s(self) -> float:
        """The total as it would be on the reference computer."""
        return self.total_s * REFERENCE_LOOP_S / self.loop_s

    def __str__(self) -> str:
        return (
            f"processor time: {self.total_s:.0f} s ({self.user_s:.0f} s user, {self.system_s:.0f} s system)\n"
            f"calibration loop: {self.loop_s * 1e3:.0f} ms meanwhile, {self.least_loop_s * 1e3:.0f} ms at best; "
            f"{REFERENCE_LOOP_S * 1e3:.0f} ms on the reference computer, where this were {self.scaled_s:.0f} s "
            f"(limit: {LIMIT_S:.0f} s)"
        )


class Calibration:
    """The calibration loop's times, sampled before, beside and after a command, on a thread of its own."""

    def __init__(self) -> None:
        self.samples_s = [loop_s() for _ in range(ROUNDS_AT_EACH_END)]
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._sample, name="calibration")

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        self._thread.join()
        self.samples_s += [loop_s() for _ in range(ROUNDS_AT_EACH_END)]

    def _sample(self) -> None:
        while not self._end.wait(SAMPLED_EVERY_S):
            self.samples_s.append(loop_s())


def loop_s() -> float:
    """Return the processor time of one calibration loop in s."""
    # tests do little else than this: calls, dictionaries, texts, small objects
    started = time.thread_time()
    seen: dict[str, list[float]] = {}
    for number in range(30_000):
        key = f"scan {number % 613}"
        row = seen.setdefault(key, [])
        row.append(_step(number, float(len(row))))
    json.loads(json.dumps(seen))
    return time.thread_time() - started


def _step(number: int, offset: float) -> float:
    return sum((offset, number * 1e-9, offset * 0.5))


def measured(command: list[str]) -> tuple[int, Cost]:
    """Return the exit code of a command, and its cost."""
    import resource  # on POSIX only, as the Makefile is

    calibration = Calibration()
    if sys.platform == "linux":
        # a process whose parent is gone becomes this one's child, so that its time is counted too
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    process = subprocess.Popen(command)
    # Ctrl-C reaches the command by itself; what it took is printed all the same
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    calibration.start()
    code = _wait_for(process.pid)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    calibration.stop()
    samples = calibration.samples_s
    return code, Cost(used.ru_utime, used.ru_stime, min(samples), statistics.median(samples))


def _wait_for(wanted: int) -> int:
    while True:
        pid, status = os.wait()
        if pid == wanted:
            return os.waitstatus_to_exitcode(status)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fail-above", type=float, metavar="FACTOR", help="of the limit, scaled to this computer")
    parser.add_argument("command", nargs=argparse.REMAINDER)
    options = parser.parse_args(arguments)
    code, cost = measured(options.command)
    sys.stdout.write(f"{cost}\n")
    if code != 0:
        return code if code > 0 else 128 - code
    if options.fail_above is not None and cost.scaled_s > options.fail_above * LIMIT_S:
        sys.stdout.write(
            f"{cost.scaled_s:.0f} s are above {options.fail_above:g} times the limit of {LIMIT_S:.0f} s; "
            "`make test-times` lists the processor time of each folder, and the most expensive tests\n"
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
