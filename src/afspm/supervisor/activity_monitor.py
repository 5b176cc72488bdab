"""A look from outside at a process that does not beat: the operating system tells whether it works.

Beats come from a thread of Python. Code that holds Python's lock for long, such as a call into a library, or the
loading of a large one off a slow disk, lets none through, and yet it works.
"""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import psutil

LEAST_SHARE = 0.05
"""Of a processor's time, to count as work. Threads that wait for Python's lock look for it 200 times a second, which
takes some thousandths each, and those of a socket library live on while all else hangs."""
LOOKS = 10
"""So many looks are made in the time that is judged by, at most: a wait for a disk is seen only while it lasts."""


@dataclass(frozen=True, slots=True)
class ActivitySample:
    """A process as it is seen at one time.

    Attributes:
        processor_s: the processor time that it has used in its life.
        waits_for_disk: one of its threads does.
        stopped: somebody has stopped it: it does nothing now, whatever it did a moment before.
        runs: its main thread does, or would if the processor were free.
    """

    processor_s: float
    waits_for_disk: bool = False
    stopped: bool = False
    runs: bool = False


Look = Callable[[int], ActivitySample | None]


class ActivityMonitor:
    """Looks at one process again and again, and judges by what it has done lately.

    Args:
        pid: of the process.
        lately_s: how long ago that may be, real time.
        look: sees what there is to be seen, for tests.

    Attributes:
        again_s: when to look next, in real monotonic time.
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
        """The processor time that the process has used in its life; None: that can't be told."""
        return self._seen[-1][1].processor_s if self._seen else None

    def work(self, now_s: float) -> bool | None:
        """Return whether it works, in real monotonic time; None: that can't be told, or not yet."""
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
        # on a busy computer the share of one that works may be less than any; and one that has just done so has yet to
        # beat
        if any(seen.waits_for_disk or seen.runs for _, seen in self._seen):
            return True
        since_s, first = self._seen[0]
        if now_s - since_s < self._lately_s / 2.0:
            return None
        return signs.processor_s - first.processor_s >= LEAST_SHARE * (now_s - since_s)


def of_process(pid: int) -> ActivitySample | None:
    """Return what the operating system says of a process; None: nothing, or there is none."""
    try:
        process = psutil.Process(pid)
        with process.oneshot():
            times, status = process.cpu_times(), process.status()
            waits_for_disk = sys.platform == "linux" and any(map(_waits_for_disk, process.threads()))
    except psutil.Error:
        return None
    return ActivitySample(
        processor_s=times.user + times.system,
        waits_for_disk=waits_for_disk,
        stopped=status in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP),
        # elsewhere it is not told apart from waiting
        runs=sys.platform == "linux" and status == psutil.STATUS_RUNNING,
    )


def _waits_for_disk(thread: Any) -> bool:
    try:
        return bool(psutil.Process(thread.id).status() == psutil.STATUS_DISK_SLEEP)  # Linux knows threads as processes
    except psutil.Error:  # threads come and go
        return False
