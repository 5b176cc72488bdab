"""Work for a disk, in threads of its own: a disk that hangs delays no process for longer than a moment.

Control, retraction and notification never wait for a disk. What must be written before something is told is waited for,
`DEADLINE_S` at most; then that is said, and the process goes on. The work is still done once the disk answers again.

What is written is handed to the system at once, so that it outlives a kill of all processes, and is on the disk
`SYNC_PERIOD_S` later, so that it outlives a power cut.
"""

from __future__ import annotations

import errno
import logging
import os
import queue
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

DEADLINE_S = 0.2
SYNC_PERIOD_S = 0.1
MOST_BYTES = 256 << 20
"""So much may wait for a disk that hangs; what comes beyond is not written."""
MOST_TASKS = 10_000
FULL_BYTES = 1 << 20
"""With less room a disk counts as full: it takes no scan any more."""
_log = logging.getLogger("afspm.disk")


class DiskTimeout(OSError):
    """The disk has not answered in time."""

    def __init__(self, within_s: float = DEADLINE_S) -> None:
        super().__init__(f"the disk did not answer within {within_s:g} s")


class DiskBacklogFull(DiskTimeout):
    """So much waits for the disk that this is never written."""


class DiskTask:
    """Something to do; `done` is held until it is."""

    __slots__ = ("done", "error", "size", "work")

    def __init__(self, work: Callable[[], object], size: int) -> None:
        self.work = work
        self.size = size
        self.error: Exception | None = None
        self.done = threading.Lock()
        self.done.acquire()

    def wait(self) -> None:
        """Wait until it is done, however long that takes. Raises what `work` raised."""
        with self.done:
            if self.error is not None:
                raise self.error


class DiskThread:
    """A thread that does one task after the other.

    Attributes:
        hangs: something was not done in time, and is not done yet: nothing is waited for until it is.
    """

    def __init__(self, deadline_s: float = DEADLINE_S, most_bytes: int = MOST_BYTES) -> None:
        self.hangs = False
        self._deadline_s = deadline_s
        self._most_bytes = most_bytes
        self._tasks: queue.SimpleQueue[DiskTask | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._bytes = self._count = 0
        self._thread: threading.Thread | None = None

    def run(self, work: Callable[[], object], size: int = 0) -> None:
        """Have something done, and wait for it.

        Args:
            size: bytes that it keeps in memory until then.

        Raises:
            DiskTimeout: not in time; it is done later.
            DiskBacklogFull: too much waits; it is never done.
            Exception: what `work` raises.
        """
        task = self.submit(work, size)
        if not task.done.acquire(timeout=0.0 if self.hangs else self._deadline_s):
            self.hangs = True
            raise DiskTimeout(self._deadline_s)
        if task.error is not None:
            raise task.error

    def submit(self, work: Callable[[], object], size: int = 0) -> DiskTask:
        """Have something done, and wait for nothing. Raises DiskBacklogFull."""
        with self._lock:
            if self._count and (self._bytes + size > self._most_bytes or self._count >= MOST_TASKS):
                self.hangs = True
                raise DiskBacklogFull(self._deadline_s)
            self._bytes += size
            self._count += 1
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="disk", daemon=True)
            self._thread.start()
        task = DiskTask(work, size)
        self._tasks.put(task)
        return task

    def close(self, within_s: float) -> bool:
        """Do what waits, if that does not take too long; returns whether all was done. Safe to repeat."""
        if self._thread is None:
            return True
        self._tasks.put(None)
        self._thread.join(within_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            try:
                task.work()
            except Exception as error:
                task.error = error
            with self._lock:
                self._bytes -= task.size
                self._count -= 1
                if not self._count:
                    self.hangs = False
            task.done.release()


def run_bounded(work: Callable[[], T], within_s: float) -> T:
    """Do something with the disk in a thread, once.

    Raises:
        DiskTimeout: not in time; what becomes of it then is not known.
        Exception: what `work` raises.
    """
    found: list[T] = []
    DiskThread(within_s).run(lambda: found.append(work()))
    return found[0]


class Syncer:
    """Makes sure, in a thread, that what was written is on the disk a moment later.

    A disk that refuses is logged, once until it syncs again. What it has refused is lost in a power cut, also if it
    syncs later: the system forgets it with the error.
    """

    def __init__(self, period_s: float = SYNC_PERIOD_S) -> None:
        self._period_s = period_s
        self._changed = threading.Condition()
        self._written: dict[tuple[int, int], int] = {}
        self._urgent = False
        self._asked = self._done = 0
        self._failure: OSError | None = None  # not raised yet
        self._is_failing = False
        self._thread: threading.Thread | None = None

    def soon(self, file: int) -> None:
        """Have what was written to a file, by its descriptor, on the disk within the period."""
        found = os.fstat(file)
        with self._changed:
            if (key := (found.st_dev, found.st_ino)) in self._written:
                return
            self._written[key] = os.dup(file)  # it may be closed before
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="syncer", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def folder_soon(self, folder: Path) -> None:
        """Do the same for the names of the files in a folder. Raises OSError."""
        _with_folder(folder, self.soon)

    def now(self, within_s: float) -> None:
        """Wait until all that was written until now is on the disk.

        Raises:
            DiskTimeout: not in time.
            OSError: some of what was written since the last call can't be made sure of.
        """
        with self._changed:
            if self._thread is None:
                return
            self._asked += 1
            asked, self._urgent = self._asked, True
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self._done >= asked, within_s):
                raise DiskTimeout
            failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._written or self._urgent)
                self._changed.wait_for(lambda: self._urgent, self._period_s)
                written, self._written = self._written, {}
                asked, self._urgent = self._asked, False
            failures = [error for descriptor in written.values() if (error := _sync_and_close(descriptor)) is not None]
            if written:
                self._tell(failures)
            with self._changed:
                self._failure = self._failure or next(iter(failures), None)
                self._done = asked
                self._changed.notify_all()

    def _tell(self, failures: list[OSError]) -> None:
        was_failing, self._is_failing = self._is_failing, bool(failures)
        if failures and not was_failing:
            _log.critical("what was written in the last moment may not outlive a power cut: %s", failures[0])
        elif was_failing and not failures:
            _log.info("the disk syncs again")


def is_full(folder: Path) -> bool:
    """Return whether a disk has no room for a file any more; False also if that can't be told."""
    import shutil  # imported late: it is asked when something has failed

    try:
        return shutil.disk_usage(folder).free < FULL_BYTES
    except OSError:
        return False


SYNCER = Syncer()
"""Of this process."""


_CAN_NOT_SYNC = (errno.EINVAL, errno.ENOTSUP)
"""From file systems of other computers, for folders: there is nothing to be synced."""


def _sync_and_close(descriptor: int) -> OSError | None:
    try:
        sync_data(descriptor)
    except OSError as error:
        return None if error.errno in _CAN_NOT_SYNC else error
    finally:
        os.close(descriptor)
    return None


def sync_data(descriptor: int) -> None:
    """Wait until what was written to a file is on the disk, where it can be found. Raises OSError."""
    getattr(os, "fdatasync", os.fsync)(descriptor)  # Windows and macOS have the one that does more


def sync_file(descriptor: int) -> None:
    """Wait until a new file is on the disk, all but its name. Raises OSError."""
    os.fsync(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the names of the files in a folder are on the disk. Raises OSError."""
    _with_folder(folder, os.fsync)


def _with_folder(folder: Path, sync: Callable[[int], None]) -> None:
    """Call `sync` with the descriptor of a folder; not on Windows, where there is none to wait for."""
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        sync(descriptor)
    finally:
        os.close(descriptor)
