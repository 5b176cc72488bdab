"""`python -m afspm.scheduler.drift.worker`: registers scans in a process of its own, so that nobody waits for it who
need not, and whatever a user's own estimator does, the scheduler lives.

The first message on its standard input says what it is; the end of that input ends it.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
from dataclasses import asdict
from pathlib import Path
from typing import IO

from afspm.errors import AfspmError, FileError
from afspm.plain_data import Plain
from afspm.process.parent import leave_interrupts_to_parent, take_standard_input
from afspm.scheduler.drift import pipe
from afspm.scheduler.drift.settings import DriftCompensationSettings


def main() -> int:
    """Until the scheduler has gone."""
    leave_interrupts_to_parent()
    orders, answers = _Orders(take_standard_input()), _own_output()
    first = orders.next()
    if first is None:
        return 0
    try:
        worker = _Worker(first[0], orders, answers)
    except AfspmError as error:
        pipe.write(answers, {"is": "broken", "reason": str(error)})
        return 1
    try:
        while (message := orders.next()) is not None:
            worker.take(*message)
    except BrokenPipeError:
        return 0
    return 0


class _Orders:
    """The scheduler's messages, read by a thread, so that its end is noticed while a scan is registered.

    Attributes:
        ended: the scheduler has gone, or wants no more.
    """

    def __init__(self, descriptor: int) -> None:
        self.ended = False
        self._pipe = os.fdopen(descriptor, "rb")
        self._read: queue.SimpleQueue[tuple[Plain, bytes] | None] = queue.SimpleQueue()
        threading.Thread(target=self._read_all, name="orders", daemon=True).start()

    def next(self) -> tuple[Plain, bytes] | None:
        """Wait for the next message; None: there are no more."""
        return self._read.get()

    def _read_all(self) -> None:
        while (message := pipe.read(self._pipe)) is not None:
            self._read.put(message)
        self.ended = True
        self._read.put(None)


class _Worker:
    """Answers what it is asked, one after the other."""

    def __init__(self, settings: Plain, orders: _Orders, answers: IO[bytes]) -> None:
        from afspm.scheduler.drift.worker_state import WorkerStateFile

        self._drift = DriftCompensationSettings.from_table(settings["drift"])
        self._store = WorkerStateFile(Path(settings["file"]) if settings["file"] else None)
        self._orders = orders
        self._answers = answers
        self._told_full = False
        self._begin()
        self._tell_forecast()

    def _begin(self) -> None:
        """As it was when a scan was registered last."""
        from afspm.drift.estimators import PairFailure, estimator
        from afspm.drift.trackers import tracker
        from afspm.scheduler.drift.estimation import Estimation

        failures: list[PairFailure] = []
        made = tracker(self._drift.tracker, estimator(self._drift.estimator, failures.append))
        self._estimation = Estimation(made, self._drift.rescan, self._save, failures)
        if (state := self._store.load()) is None:
            return
        try:
            self._estimation.restore(state)
        except (AfspmError, LookupError, TypeError, ValueError) as error:
            reason = f"the saved state is of another tracker, or damaged: {error}"
            hint = "use the tracker that wrote it, or remove the file: the position of the sample is then unknown"
            raise FileError(reason, where=str(self._store.path), hint=hint) from error

    def _save(self, state: Plain) -> None:
        """Unless the scheduler was killed meanwhile: the next one's worker knows more by now."""
        if self._orders.ended:
            raise BrokenPipeError
        try:
            self._store.save(state)
        except FileError as error:  # what is known of the drift now is worth more than what a kill would lose
            if not self._told_full:
                self._complain(f"the state of the drift can't be saved: {error}")
            self._told_full = True
        else:
            self._told_full = False

    def take(self, head: Plain, data: bytes) -> None:
        if head["do"] == "register":
            self._register(head, data)
            return
        try:
            self._estimation.compensated(head["time_s"], tuple(head["velocity_m_s"]))
        except AfspmError as error:
            self._complain(str(error))
        self._tell_forecast()

    def _register(self, head: Plain, data: bytes) -> None:
        try:
            answer = self._estimation.register(*pipe.job_from_head(head, data))
        except BrokenPipeError:
            raise
        except Exception as error:  # of a user's own estimator or tracker, too: it is the reason
            reason = str(error) if isinstance(error, AfspmError) else f"{type(error).__name__}: {error}"
            self._begin()  # what was half done is not to be built on
            pipe.write(self._answers, {"is": "not registered", "key": head["key"], "reason": reason})
            return
        pipe.write(self._answers, {"is": "registered", **asdict(answer)})

    def _complain(self, reason: str) -> None:
        pipe.write(self._answers, {"is": "complaint", "reason": reason})

    def _tell_forecast(self) -> None:
        pipe.write(self._answers, {"is": "forecast", "forecast": self._estimation.forecast})


def _own_output() -> IO[bytes]:
    """Standard output for our answers alone: what libraries and users print goes where errors go."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return answers


if __name__ == "__main__":
    sys.exit(main())
