"""The worker as the scheduler sees it: a process that is told scans, and whose answers come by a thread."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import subprocess
import threading
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from afspm.interpreter import python_command, python_environment
from afspm.plain_data import Plain
from afspm.scheduler.drift import pipe
from afspm.scheduler.drift.messages import Forecasted, NotRegistered, Registered, ScanJob, WorkerGone, WorkerSaid
from afspm.scheduler.drift.settings import DriftCompensationSettings

_FAREWELL_S = 1.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class DriftWorkerProcess:
    """See `told.Worker`. What it says is taken by `said`, after `wake` was called.

    Args:
        file: where the worker keeps its state; None: nowhere.

    Attributes:
        wake: called from another thread when there is something to take.
        late: keeps a simulated time from running away while a scan is registered.
    """

    def __init__(self, settings: DriftCompensationSettings, file: Path | None, log: logging.Logger) -> None:
        self._first = {"drift": asdict(settings), "file": str(file) if file else ""}
        self._log = log
        self.wake: Callable[[], None] = lambda: None
        self.late: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
        self._late = contextlib.ExitStack()
        self._said: deque[tuple[int, WorkerSaid]] = deque()
        self._life = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: queue.SimpleQueue[tuple[Plain, object] | None] = queue.SimpleQueue()

    def start(self) -> None:
        """Begin, or kill what is there and begin anew."""
        self._end(kill=True)
        self._life += 1
        command = python_command("afspm.scheduler.drift.worker")
        try:
            # it complains where we do; small matrices are not worth more threads than one
            environment = {**dict.fromkeys(_THREADS, "1"), **os.environ, **python_environment()}
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        except OSError as error:
            self._tell(self._life, WorkerGone(f"it can't be started: {error}"))
            return
        self._orders = queue.SimpleQueue()
        for run, name in ((_write_all, "orders"), (self._read_all, "answers")):
            arguments = (self._process, self._orders) if run is _write_all else (self._process, self._life)
            threading.Thread(target=run, args=arguments, name=f"drift {name}", daemon=True).start()
        self._orders.put((self._first, None))

    def register(self, job: ScanJob) -> None:
        self._late.enter_context(self.late())
        self._orders.put((pipe.job_to_head(job), job.scan.values))

    def compensated(self, time_s: float, velocity_m_s: tuple[float, float]) -> None:
        self._orders.put(({"do": "compensated", "time_s": time_s, "velocity_m_s": velocity_m_s}, None))

    def said(self) -> list[WorkerSaid]:
        """Return the worker's messages since the last call, oldest first; those of a former worker are dropped."""
        said = []
        while self._said:
            life, event = self._said.popleft()
            if life == self._life:
                said.append(event)
        return said

    def caught_up(self) -> None:
        """Let simulated time pass again: the worker's messages about scans are handled."""
        self._late.close()

    def close(self) -> None:
        """End the worker: its state is on disk."""
        self._late.close()
        self._life += 1
        self._end(kill=False)

    def _end(self, *, kill: bool) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        self._orders.put(None)
        if kill:
            process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_FAREWELL_S)
        process.kill()
        process.wait()

    def _read_all(self, process: subprocess.Popen[bytes], life: int) -> None:
        """In a thread: from the worker's first word to its end."""
        reason = ""
        assert process.stdout is not None
        with contextlib.suppress(OSError, ValueError), process.stdout:
            while (message := pipe.read(process.stdout)) is not None:
                head, _ = message
                kind = head.pop("is")
                if kind == "broken":
                    reason = head["reason"]
                elif kind == "complaint":
                    self._log.error("drift: %s", head["reason"])
                else:
                    self._tell(life, _SAID[kind](**head))
        code = process.wait()
        self._tell(life, WorkerGone(reason or f"exit code {code}"))

    def _tell(self, life: int, event: WorkerSaid) -> None:
        self._said.append((life, event))
        self.wake()


_SAID: dict[str, Callable[..., WorkerSaid]] = {
    "registered": Registered,
    "not registered": NotRegistered,
    "forecast": Forecasted,
}


def _write_all(process: subprocess.Popen[bytes], orders: queue.SimpleQueue[tuple[Plain, Any] | None]) -> None:
    """In a thread: a worker that is busy does not read, and the scheduler must not wait for it."""
    assert process.stdin is not None
    with contextlib.suppress(OSError, ValueError), process.stdin:
        while (order := orders.get()) is not None:
            pipe.write(process.stdin, *order)
