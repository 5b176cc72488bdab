"""Activity of a process without heartbeats, as measured by the operating system.

Heartbeats come from a Python thread. Code that holds Python's lock for long (a call into a library, the import of a
large library from a slow disk) stops the heartbeats although the process works.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import psutil

LEAST_SHARE = 0.05
"""Share of a processor above which a process counts as working. A hanging process uses less: threads that wait for
Python's lock poll it 200 times a second, which takes some thousandths, and threads of a socket library run on."""
LOOKS = 10
"""Samples in the judged time span: frequent, since a wait for the disk shows only while it lasts."""


@dataclass(frozen=True, slots=True)
class ActivitySample:
    """Activity of a process at one moment.

    Attributes:
        processor_s: processor time used since the process started.
        waits_for_disk: whether one of its threads waits for the disk.
        stopped: whether the process is suspended (SIGSTOP); then it counts as idle, even if it worked a moment before.
        runs: whether its main thread is running, or ready to run.
    """

    processor_s: float
    waits_for_disk: bool = False
    stopped: bool = False
    runs: bool = False


Look = Callable[[int], ActivitySample | None]


class ActivityMonitor:
    """A monitor that samples one process repeatedly, and decides from the latest samples whether the process works.

    Args:
        pid: process to sample.
        lately_s: age up to which samples count, in s of real time.
        look: takes a sample; replaced in tests.

    Attributes:
        again_s: time of the next sample, real monotonic time.
    """

    def __init__(self, pid: int, lately_s: float, look: Look | None = None) -> None:
        self._pid = pid
        self._lately_s = lately_s
        self._look = look or of_process
        self._seen: deque[tuple[float, ActivitySample]] = deque()
        self._works: bool | None = None
        self.again_s = -math.inf

    @property
    def processor_s(self) -> float | None:
        """Processor time used since the process started; None if unknown."""
        return self._seen[-1][1].processor_s if self._seen else None

    def work(self, now_s: float) -> bool | None:
        """Take a sample if it is due, and return whether the process works; None if unknown."""
        if now_s >= self.again_s:
            self.again_s = now_s + self._lately_s / LOOKS
            self._works = self._judge(self._look(self._pid), now_s)
        return self._works

    def _judge(self, signs: ActivitySample | None, now_s: float) -> bool | None:
        if signs is None:
            return None
        self._seen.append((now_s, signs))
        while len(self._seen) > 2 and now_s - self._seen[1][0] >= self._lately_s:
            self._seen.popleft()
        if signs.stopped:
            return False
        # on a busy computer a working process may get less than LEAST_SHARE, and one that has just stopped working has
        # yet to send its heartbeat
        if any(seen.waits_for_disk or seen.runs for _, seen in self._seen):
            return True
        since_s, first = self._seen[0]
        if now_s - since_s < self._lately_s / 2.0:
            return None
        return signs.processor_s - first.processor_s >= LEAST_SHARE * (now_s - since_s)


def of_process(pid: int) -> ActivitySample | None:
    """Return a sample of a process; None if there is no such process, or the operating system gives no data."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times, status = process.cpu_times(), process.status()
            waits_for_disk = sys.platform == "linux" and any(_waits_for_disk(one.id) for one in process.threads())
    except psutil.Error:
        return None
    return ActivitySample(
        processor_s=times.user + times.system,
        waits_for_disk=waits_for_disk,
        stopped=status in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP),
        # other systems don't distinguish running from waiting
        runs=sys.platform == "linux" and status == psutil.STATUS_RUNNING,
    )


def _waits_for_disk(thread_id: int) -> bool:
    try:
        return bool(psutil.Process(thread_id).status() == psutil.STATUS_DISK_SLEEP)  # Linux knows threads as processes
    except psutil.Error:  # threads come and go
        return False
