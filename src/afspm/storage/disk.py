"""Threads for disk operations, so that a hanging disk delays a process for a moment only.

Control, retraction and notification never wait for a disk. A write that must precede a publication is awaited for at
most `DEADLINE_S`; then the process logs the delay and continues. The write is carried out once the disk answers again.

Written data are handed to the system at once, so that they survive a kill of all processes, and are on the disk
`SYNC_PERIOD_S` later, so that they survive a power cut.
"""

from __future__ import annotations

import errno
import logging
import os
import queue
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

DEADLINE_S = 0.2  # for which one write may hold up its process
SYNC_PERIOD_S = 0.1  # what a power cut may take
MOST_BYTES = 256 << 20
"""Limit in bytes on data that wait for a hanging disk; further data are not written."""
MOST_TASKS = 10_000  # the same limit by number
FULL_BYTES = 1 << 20
"""Free bytes below which a disk counts as full: too little for a usual scan."""
_log = logging.getLogger("afspm.disk")


class DiskTimeout(OSError):
    """The error that the disk did not answer in time."""

    def __init__(self, within_s: float = DEADLINE_S) -> None:
        super().__init__(f"the disk did not answer within {within_s:g} s")


class DiskBacklogFull(DiskTimeout):
    """The error that data were not written, since the disk's backlog is full."""


class DiskTask:
    """A task of a disk thread; `done` is locked until the task is finished."""

    __slots__ = ("done", "error", "size", "work")

    def __init__(self, work: Callable[[], object], size: int) -> None:
        self.work = work
        self.size = size
        self.error: Exception | None = None
        self.done = threading.Lock()
        self.done.acquire()

    def wait(self) -> None:
        """Wait until the task is finished, without a time limit. Raises any exception of `work`."""
        with self.done:
            if self.error is not None:
                raise self.error


class _Backlog:
    # shared by a DiskThread and its thread, which must not keep the DiskThread alive

    def __init__(self) -> None:
        self.tasks: queue.SimpleQueue[DiskTask | None] = queue.SimpleQueue()
        self.lock = threading.Lock()
        self.bytes = self.count = 0
        self.hangs = False

    def work(self) -> None:
        while (task := self.tasks.get()) is not None:
            try:
                task.work()
            except Exception as error:  # the work may be any code; the caller that waits raises its error
                task.error = error
            with self.lock:
                self.bytes -= task.size
                self.count -= 1
                if not self.count:
                    self.hangs = False
            task.done.release()
            del task  # its work may hold the owner of the DiskThread


class DiskThread:
    """A thread that runs one task after the other; it ends after the last task once this object is gone."""

    def __init__(self, deadline_s: float = DEADLINE_S, most_bytes: int = MOST_BYTES) -> None:
        self._deadline_s = deadline_s
        self._most_bytes = most_bytes
        self._backlog = _Backlog()
        self._thread: threading.Thread | None = None

    @property
    def hangs(self) -> bool:
        """True from a late or refused task until all tasks are finished; meanwhile `run` does not wait."""
        return self._backlog.hangs

    def run(self, work: Callable[[], object], size: int = 0) -> None:
        """Run a task and wait for it.

        Args:
            size: bytes that the task keeps in memory.

        Raises:
            DiskTimeout: not in time; the task is finished later.
            DiskBacklogFull: too many tasks or bytes wait; the task never runs.
            Exception: any exception of `work`.
        """
        task = self.submit(work, size)
        # while the disk hangs no caller waits again: each would lose the deadline
        if not task.done.acquire(timeout=0.0 if self.hangs else self._deadline_s):
            self._backlog.hangs = True
            raise DiskTimeout(self._deadline_s)
        if task.error is not None:
            raise task.error

    def submit(self, work: Callable[[], object], size: int = 0) -> DiskTask:
        """Queue a task without waiting.

        Raises:
            DiskBacklogFull: too many tasks or bytes wait; the task never runs.
        """
        backlog = self._backlog
        with backlog.lock:
            if backlog.count and (backlog.bytes + size > self._most_bytes or backlog.count >= MOST_TASKS):
                backlog.hangs = True
                raise DiskBacklogFull(self._deadline_s)
            backlog.bytes += size
            backlog.count += 1
        if self._thread is None:
            self._thread = threading.Thread(target=backlog.work, name="disk", daemon=True)
            self._thread.start()
            # not at the end of the process, which does not wait for a disk
            weakref.finalize(self, backlog.tasks.put, None).atexit = False
        task = DiskTask(work, size)
        backlog.tasks.put(task)
        return task

    def close(self, within_s: float) -> bool:
        """Finish the queued tasks within a time limit, and end the thread; return whether all are finished.

        Safe to repeat. A later task starts another thread.
        """
        if self._thread is None:
            return True
        self._backlog.tasks.put(None)
        self._thread.join(within_s)
        if self._thread.is_alive():
            return False
        self._thread = None
        return True


def run_bounded(work: Callable[[], T], within_s: float) -> T:
    """Run a disk operation once, in a new thread, within a time limit.

    Raises:
        DiskTimeout: not in time; the outcome is unknown.
        Exception: any exception of `work`.
    """
    found: list[T] = []
    DiskThread(within_s).run(lambda: found.append(work()))
    return found[0]


class Syncer:
    """A thread that syncs written data to the disk a moment later.

    An error of the disk is logged once, until a sync succeeds again. A later successful sync does not help: the system
    drops the data of a failed sync, and a power cut loses them.
    """

    def __init__(self, period_s: float = SYNC_PERIOD_S, sync: Callable[[int], None] | None = None) -> None:
        self._period_s, self._sync = period_s, sync
        self._changed = threading.Condition()
        self._written: dict[tuple[int, int], int] = {}
        self._urgent = False
        self._asked = self._done = 0
        self._failure: OSError | None = None  # raised by the next `now`
        self._is_failing = False
        self._thread: threading.Thread | None = None

    def soon(self, file: int) -> None:
        """Sync the data written to an open file within the period."""
        # by inode: a file that is written often, or through several descriptors, is synced once a period
        found = os.fstat(file)
        with self._changed:
            if (key := (found.st_dev, found.st_ino)) in self._written:
                return
            self._written[key] = os.dup(file)  # the caller may close its own descriptor before the sync
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="syncer", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def folder_soon(self, folder: Path) -> None:
        """Sync the names of the files in a folder within the period.

        Raises:
            OSError: the folder can't be opened.
        """
        _with_folder(folder, self.soon)

    def now(self, within_s: float) -> None:
        """Wait until all data passed to `soon` and `folder_soon` so far are on the disk.

        Raises:
            DiskTimeout: not in time.
            OSError: some data written since the last call can't be synced.
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
            failures = [
                error
                for descriptor in written.values()
                if (error := _sync_and_close(descriptor, self._sync or sync_data)) is not None
            ]
            if written:
                self._log_change(failures)
            with self._changed:
                self._failure = self._failure or next(iter(failures), None)
                self._done = asked
                self._changed.notify_all()

    def _log_change(self, failures: list[OSError]) -> None:
        was_failing, self._is_failing = self._is_failing, bool(failures)
        if failures and not was_failing:
            _log.critical("the data written in the last moment may be lost in a power cut: %s", failures[0])
        elif was_failing and not failures:
            _log.info("the disk syncs again")


def is_full(folder: Path, least_free: int = FULL_BYTES) -> bool:
    """Return whether a disk has no room for another file; False if unknown."""
    import shutil  # imported late: needed only after a failure

    try:
        return shutil.disk_usage(folder).free < least_free
    except OSError:
        return False


SYNCER = Syncer()
"""The syncer that the whole process shares."""


_CAN_NOT_SYNC = (errno.EINVAL, errno.ENOTSUP)
"""Errors of network file systems for the sync of a folder: they have nothing to sync."""


def _sync_and_close(descriptor: int, sync: Callable[[int], None]) -> OSError | None:
    try:
        sync(descriptor)
    except OSError as error:
        return None if error.errno in _CAN_NOT_SYNC else error
    finally:
        os.close(descriptor)
    return None


def sync_data(descriptor: int) -> None:
    """Wait until the data of a file are on the disk.

    Raises:
        OSError: the disk refuses.
    """
    # Windows and macOS have only fsync, which also syncs the times of the file
    getattr(os, "fdatasync", os.fsync)(descriptor)


def sync_file(descriptor: int) -> None:
    """Wait until a new file is on the disk, except its name.

    Raises:
        OSError: the disk refuses.
    """
    os.fsync(descriptor)


def sync_folder(folder: Path) -> None:
    """Wait until the names of the files in a folder are on the disk.

    Raises:
        OSError: the disk refuses.
    """
    _with_folder(folder, os.fsync)


def _with_folder(folder: Path, sync: Callable[[int], None]) -> None:
    # Windows can't open folders, and needs no sync of them
    if sys.platform == "win32":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        sync(descriptor)
    finally:
        os.close(descriptor)
