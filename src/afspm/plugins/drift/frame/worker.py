"""Worker process that registers scans, so that errors and long computations don't stop the scheduler.

The worker processes jobs one after the other, and saves its state before it reports. The process ends when the
connection for jobs closes, or with the scheduler's process, even during a registration: a restarted scheduler has its
own worker.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import connection
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

import numpy as np

from afspm.basics import AfspmError, ExitCode, FileError, Plain
from afspm.plugins.drift.estimators import PairFailure, estimator
from afspm.plugins.drift.frame.estimation import Estimation
from afspm.plugins.drift.frame.messages import (
    Compensated,
    Forecasted,
    NotRegistered,
    ScanJob,
    StartWorker,
    WorkerGone,
    WorkerReport,
)
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.plugins.drift.frame.worker_state import WorkerStateFile
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track import tracker
from afspm.transport import leave_interrupts_to_parent


@dataclass(frozen=True)
class Complaint:
    """Error of the worker for the log; the worker continues."""

    reason: str


class Reports(Protocol):
    """Receiver of a worker's reports."""

    def send(self, obj: object, /) -> None: ...


class DriftWorkerInProcess:
    """Worker without a separate process, for tests; see `scheduler.shell.FrameWorker`.

    `take` returns when the job is done.

    Args:
        file: file for the worker's state; None: the state is not saved.

    Attributes:
        wake: function called when a report is available.
    """

    def __init__(self, settings: DriftCompensationSettings, file: Path | None, log: logging.Logger) -> None:
        self.wake: Callable[[], None] = lambda: None
        self._settings, self._file, self._log = settings, file, log
        self._reports: deque[object] = deque()
        self._worker: _Worker | None = None

    def take(self, job: object) -> None:
        if isinstance(job, StartWorker):
            try:
                self._worker = _Worker(self._settings, WorkerStateFile(self._file), self)
            except AfspmError as error:
                self.send(WorkerGone(str(error)))
        elif self._worker is not None and isinstance(job, ScanJob | Compensated):
            self._worker.take(job)

    def send(self, report: object) -> None:
        if isinstance(report, Complaint):
            self._log.error("drift: %s", report.reason)
            return
        self._reports.append(report)
        self.wake()

    def reports(self) -> Iterator[object]:
        while self._reports:
            yield self._reports.popleft()

    def close(self) -> None:
        """Do nothing, since the state is on disk."""


def main(jobs: Connection, reports: Connection, settings: DriftCompensationSettings, file: Path | None) -> None:
    """Register scans until the connection for jobs closes.

    A saved state that can't be used is reported as `WorkerGone`, and ends the process with exit code 1.
    """
    leave_interrupts_to_parent()
    # a user's estimator may print: its output belongs with the errors
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    threading.Thread(target=_end_with_parent, name="parent", daemon=True).start()
    try:
        worker = _Worker(settings, WorkerStateFile(file), reports)
    except AfspmError as error:
        reports.send(WorkerGone(str(error)))
        sys.exit(1)
    while True:
        try:
            job: ScanJob | Compensated = jobs.recv()
        except EOFError:
            return
        worker.take(job)


def _end_with_parent() -> None:
    # at once, even during a registration: otherwise it would overwrite the state that the next worker has read
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(ExitCode.ORPHAN)


class _Worker:
    def __init__(self, settings: DriftCompensationSettings, store: WorkerStateFile, reports: Reports) -> None:
        self._settings = settings
        self._store = store
        self._reports = reports
        self._is_full_logged = False
        self._estimation = self._saved()
        self._report(Forecasted(self._estimation.forecast))

    def _saved(self) -> Estimation:
        # from disk: the state after the last registered scan
        failures: list[PairFailure] = []
        made = tracker(self._settings.tracker, estimator(self._settings.estimator, failures.append))
        estimation = Estimation(made, self._settings.rescan, self._save, failures)
        if (state := self._store.load()) is None:
            return estimation
        try:
            estimation.restore(state)
        except (AfspmError, LookupError, TypeError, ValueError) as error:
            reason = f"the saved state is of another tracker, or damaged: {error}"
            hint = "use the tracker that wrote it, or remove the file: the position of the sample is then unknown"
            raise FileError(reason, where=str(self._store.path), hint=hint) from error
        return estimation

    def _save(self, state: Plain) -> None:
        try:
            self._store.save(state)
        except FileError as error:  # the present forecast is worth more than a state for a restart
            if not self._is_full_logged:
                self._report(Complaint(f"the state of the drift can't be saved: {error}"))
            self._is_full_logged = True
        else:
            self._is_full_logged = False

    def take(self, job: ScanJob | Compensated) -> None:
        if isinstance(job, ScanJob):
            self._report(self._register(job))
            return
        try:
            self._estimation.compensated(job.time_s, job.velocity_m_s)
        except AfspmError as error:
            self._report(Complaint(str(error)))
        self._report(Forecasted(self._estimation.forecast))

    def _register(self, job: ScanJob) -> WorkerReport:
        scan, name = job.scan, job.scan.filename or job.key
        values = np.ascontiguousarray(scan.values, np.float64)
        drift_scan = DriftScan(values, scan.region, job.start_s, job.end_s, job.upwards, name)
        try:
            return self._estimation.register(job.key, drift_scan, job.asked)
        except Exception as error:  # a user's own estimator or tracker may raise anything; its text becomes the reason
            reason = str(error) if isinstance(error, AfspmError) else f"{type(error).__name__}: {error}"
            self._estimation = self._saved()  # without the half-processed scan
            return NotRegistered(job.key, reason)

    def _report(self, report: WorkerReport | Complaint) -> None:
        self._reports.send(report)
