"""Scheduler's side of the worker: a child process for the jobs, and a thread that receives the reports."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from afspm.plugins.drift.frame.messages import Forecasted, ScanJob, StartWorker, WorkerGone, WorkerReport
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.worker import Complaint, main

_FAREWELL_S = 1.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# a scan of 512 x 512 pixels takes 61 ms of processor time here, besides its registration, and 15 ms in the scheduler
# spawn: a forked child would hold the scheduler's sockets and locks
# a process and not a pool: `concurrent.futures` has no public way to kill a worker that hangs
_CONTEXT = multiprocessing.get_context("spawn")


class DriftWorkerProcess:
    """Implementation of `scheduler.shell.FrameWorker` by a child process.

    Args:
        file: file for the worker's state; None: the state is not saved.

    Attributes:
        wake: function called from another thread when a report is available.
        late: context that slows simulated time down to real time, entered while a scan is registered.
    """

    def __init__(self, settings: DriftCompensationSettings, file: Path | None, log: logging.Logger) -> None:
        self.wake: Callable[[], None] = lambda: None
        self.late: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
        self._settings = settings
        self._file = file
        self._log = log
        self._late = contextlib.ExitStack()
        self._reports: deque[tuple[int, WorkerReport]] = deque()
        self._life = 0
        self._process: BaseProcess | None = None
        # only one thread gets a child's exit code from the system; the other would return before it is stored
        self._reaping = threading.Lock()
        self._jobs: queue.SimpleQueue[object] = queue.SimpleQueue()

    def take(self, job: object) -> None:
        """Queue a job for the worker, or restart the worker; do not wait for the result."""
        if isinstance(job, StartWorker):
            self._start()
            return
        if isinstance(job, ScanJob):
            self._late.enter_context(self.late())
        self._jobs.put(job)

    def reports(self) -> Iterator[WorkerReport]:
        """Yield the reports since the last call, oldest first; drop reports of an earlier worker.

        Simulated time runs at full speed again once the report about a scan is handled.
        """
        while self._reports:
            life, report = self._reports.popleft()
            if life == self._life:
                yield report
                if not isinstance(report, Forecasted):
                    self._late.close()

    def close(self) -> None:
        """End the worker, after a second by a kill. The state of the worker is on disk."""
        self._life += 1
        self._end(within_s=_FAREWELL_S)

    def _start(self) -> None:
        self._end(within_s=0.0)
        self._life += 1
        from_us, jobs = _CONTEXT.Pipe(duplex=False)
        reports, to_us = _CONTEXT.Pipe(duplex=False)
        process = _CONTEXT.Process(
            target=main, args=(from_us, to_us, self._settings, self._file), name="drift worker", daemon=True
        )
        try:
            with _one_thread_each():
                process.start()
        except OSError as error:
            for end in (jobs, reports):
                end.close()
            self._add(self._life, WorkerGone(f"it can't be started: {error}"))
            return
        finally:  # closed here, so that only the child holds them and their end shows its end
            from_us.close()
            to_us.close()
        self._process, self._jobs = process, queue.SimpleQueue()
        threading.Thread(target=_write_all, args=(jobs, self._jobs), name="drift jobs", daemon=True).start()
        arguments = (process, reports, self._life)
        threading.Thread(target=self._read_all, args=arguments, name="drift reports", daemon=True).start()

    def _end(self, *, within_s: float) -> None:
        self._late.close()
        process, self._process = self._process, None
        if process is None:
            return
        self._jobs.put(None)
        process.join(within_s)
        process.kill()
        # no wait for the reading thread: a process forked by an estimator may hold the pipe open
        with self._reaping:
            process.join()

    def _read_all(self, process: BaseProcess, reports: Connection, life: int) -> None:
        # in a thread: from the worker's first report to its end
        gone = None
        with contextlib.suppress(EOFError, OSError), reports:
            while True:
                report = reports.recv()
                if isinstance(report, WorkerGone):
                    gone = report
                elif isinstance(report, Complaint):
                    self._log.error("drift: %s", report.reason)
                else:
                    self._add(life, report)
        with self._reaping:
            process.join()
        self._add(life, gone or WorkerGone(f"exit code {process.exitcode}"))

    def _add(self, life: int, report: WorkerReport) -> None:
        self._reports.append((life, report))
        self.wake()


def _write_all(jobs: Connection, waiting: queue.SimpleQueue[object]) -> None:
    # in a thread: a busy worker does not read, and the scheduler must not wait for it
    with contextlib.suppress(OSError), jobs:
        while (job := waiting.get()) is not None:
            jobs.send(job)


@contextlib.contextmanager
def _one_thread_each() -> Iterator[None]:
    # small matrices gain nothing from more threads; the child's libraries read the variables as they are loaded
    added = [name for name in _THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]
