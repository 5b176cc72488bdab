"""The worker: its state survives a kill, and a user's own estimator can't harm the scheduler."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import deadlines
import numpy as np
import psutil
import pytest
from deadlines import DEADLINE_S
from tests.plugins.drift.drift_parts import Brightest

from afspm.basics import ConfigError, FileError
from afspm.model import Frame, Region, Scan
from afspm.plugins.drift.frame import worker_process
from afspm.plugins.drift.frame.estimation import Estimation
from afspm.plugins.drift.frame.messages import (
    Forecasted,
    NotRegistered,
    Registered,
    ScanJob,
    StartWorker,
    WorkerGone,
    WorkerReport,
)
from afspm.plugins.drift.frame.settings import DriftCompensationSettings, RescanRule
from afspm.plugins.drift.frame.worker_process import DriftWorkerProcess
from afspm.plugins.drift.frame.worker_state import WorkerStateFile
from afspm.plugins.drift.registration import DriftScan
from afspm.plugins.drift.track import tracker

HERE = Region((0.0, 0.0), (63e-9, 63e-9))


def picture(x: int, y: int) -> np.ndarray:
    values = np.zeros((64, 64))
    values[y, x] = 1.0
    return values


def job(number: int, x: int, y: int, asked: Region | None = None) -> ScanJob:
    scan = Scan(HERE, "Height", "m", picture(x, y), None, f"{number}.nc")
    return ScanJob(f"{number}.nc 0", scan, number * 100.0, number * 100.0 + 50.0, None, asked)


def drift_scan(number: int, x: int, y: int) -> tuple[str, DriftScan]:
    """Return the key and the scan, for `Estimation.register`."""
    end_s = number * 100.0 + 50.0
    return f"{number}.nc 0", DriftScan(picture(x, y), HERE, number * 100.0, end_s, None, f"{number}.nc")


def estimation(store: WorkerStateFile, rule: RescanRule | None = None) -> Estimation:
    made = Estimation(tracker("paper", Brightest()), rule or RescanRule(), store.save, [])
    if (state := store.load()) is not None:
        made.restore(state)
    return made


# --- what it does ---


def test_a_repeated_scan_is_answered_from_memory_and_not_taken_twice(tmp_path: Path) -> None:
    store = WorkerStateFile(tmp_path / "drift.npz")
    first = estimation(store)
    first.register(*drift_scan(0, 30, 30))
    answer = first.register(*drift_scan(1, 33, 28))
    np.testing.assert_allclose(np.array(answer.matrix)[:2, 2], [-3e-9, 2e-9], atol=1e-18)
    assert answer.residual_m == pytest.approx([3e-9, -2e-9])
    assert answer.references == ["0.nc"]
    second = estimation(store)  # after a kill
    assert second.register(*drift_scan(1, 33, 28)) == answer
    assert second.forecast == answer.forecast
    third = estimation(store)
    assert third.register(*drift_scan(2, 36, 26)) == second.register(*drift_scan(2, 36, 26))


def test_before_the_first_scan_nothing_is_known(tmp_path: Path) -> None:
    assert estimation(WorkerStateFile(None)).forecast is None


@pytest.mark.parametrize(
    ("rule", "again"),
    [
        (RescanRule("tolerance", tolerance=10e-9), True),
        (RescanRule("tolerance", tolerance=40e-9), False),
        (RescanRule("tolerance"), True),
        (RescanRule("paper", f_rescan=0.75), True),
        (RescanRule("paper", f_rescan=0.5), False),
        (RescanRule("never"), False),
    ],
)
def test_a_scan_too_far_from_its_requested_region_needs_a_rescan(rule: RescanRule, again: bool) -> None:
    asked = Region((0.0, 0.0), HERE.size_m, frame=Frame.SAMPLE)
    made = estimation(WorkerStateFile(None), rule)
    assert not made.register(*drift_scan(0, 20, 20), asked).rescan  # nothing was known before
    assert bool(made.register(*drift_scan(1, 35, 28), asked).rescan) is again
    assert not made.register(*drift_scan(2, 60, 60), None).rescan  # no requested region


def test_a_tracker_that_can_not_follow_a_compensation_raises() -> None:
    with pytest.raises(ConfigError, match="compensates"):
        estimation(WorkerStateFile(None)).compensated(0.0, (1e-9, 0.0))


# --- on disk ---


def test_stored_state_is_restored_to_the_last_bit(tmp_path: Path) -> None:
    state = {"a": [1, {"b": np.array([[0.1, np.nan], [-0.0, 1e300]])}], "c": "ü", "d": None, "e": np.float64(0.1)}
    WorkerStateFile(tmp_path / "deep" / "drift.npz").save(state)
    found = WorkerStateFile(tmp_path / "deep" / "drift.npz").load()
    assert found is not None
    assert found["a"][1]["b"].tobytes() == state["a"][1]["b"].tobytes()  # type: ignore[index]
    assert (found["a"][0], found["c"], found["d"], found["e"]) == (1, "ü", None, 0.1)


def test_missing_state_is_no_error_and_damaged_state_is_one(tmp_path: Path) -> None:
    assert WorkerStateFile(tmp_path / "drift.npz").load() is None
    (tmp_path / "drift.npz").write_bytes(b"PK\x03\x04 half")
    with pytest.raises(FileError, match="can't be read"):
        WorkerStateFile(tmp_path / "drift.npz").load()


def test_stored_state_contains_no_code(tmp_path: Path) -> None:
    np.savez(tmp_path / "drift.npz", json=np.array([{"x": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FileError):
        WorkerStateFile(tmp_path / "drift.npz").load()


# --- as a process ---


class Heard:
    """Waits for reports of a worker's process."""

    def __init__(self, registrar: DriftWorkerProcess) -> None:
        self.registrar = registrar
        self.all: list[WorkerReport] = []
        self._changed = threading.Condition()
        registrar.wake = self._wake

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def next(self, kind: type[WorkerReport], count: int = 1) -> WorkerReport:
        def found() -> list[WorkerReport]:
            self.all += self.registrar.reports()
            return [one for one in self.all if isinstance(one, kind)]

        with self._changed:
            assert self._changed.wait_for(lambda: len(found()) >= count, DEADLINE_S), self.all
            return found()[count - 1]


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Heard]]:
    """Starts workers with an estimator of `drift_parts`."""
    made: list[DriftWorkerProcess] = []

    def start(estimator: str = "Brightest") -> Heard:
        settings = DriftCompensationSettings(estimator=f"drift_parts.{estimator}", tracker="paper")
        made.append(DriftWorkerProcess(settings, tmp_path / "drift.npz", logging.getLogger("test")))
        heard = Heard(made[-1])
        made[-1].take(StartWorker())
        return heard

    yield start
    for one in made:
        one.close()


def process() -> BaseProcess:
    """Return the running worker."""
    (worker,) = (child for child in multiprocessing.active_children() if child.name == "drift worker")
    return worker


def test_a_user_s_own_estimator_registers_scans(work: Callable[..., Heard]) -> None:
    heard = work("Talks")
    assert heard.next(Forecasted) == Forecasted(None)
    heard.registrar.take(job(0, 30, 30))
    heard.registrar.take(job(1, 33, 28))
    answer = heard.next(Registered, 2)
    assert isinstance(answer, Registered)
    assert answer.mapping.translation_m == pytest.approx([-3e-9, 2e-9], abs=1e-18)


def test_a_killed_worker_has_its_whole_state_after_a_restart(work: Callable[..., Heard]) -> None:
    heard = work()
    heard.registrar.take(job(0, 30, 30))
    heard.registrar.take(job(1, 33, 28))
    answer = heard.next(Registered, 2)
    assert isinstance(answer, Registered)
    process().kill()
    assert isinstance(heard.next(WorkerGone), WorkerGone)
    heard.registrar.take(StartWorker())
    heard.registrar.take(job(1, 33, 28))
    assert heard.next(Registered, 3) == answer
    assert Forecasted(answer.forecast) in heard.all


def test_an_estimator_that_ends_the_process_is_reported(work: Callable[..., Heard]) -> None:
    heard = work("Dies")
    heard.registrar.take(job(0, 30, 30))
    heard.registrar.take(job(1, 33, 28))
    gone = heard.next(WorkerGone)
    assert gone == WorkerGone("exit code 7")


def test_a_hanging_worker_is_killed_by_a_restart(work: Callable[..., Heard]) -> None:
    heard = work("Hangs")
    heard.registrar.take(job(0, 30, 30))
    heard.next(Registered)
    heard.registrar.take(job(1, 33, 28))
    former = process()
    heard.registrar.take(StartWorker())
    assert former.exitcode != 0
    heard.registrar.take(job(0, 30, 30))
    heard.next(Registered, 2)  # what it had registered it remembers
    assert not [one for one in heard.all if isinstance(one, WorkerGone)]  # on purpose


def test_impossible_settings_are_the_reported_reason(work: Callable[..., Heard]) -> None:
    gone = work("NoSuch").next(WorkerGone)
    assert isinstance(gone, WorkerGone)
    assert "NoSuch" in gone.reason


def test_a_state_of_another_tracker_is_refused_with_advice(work: Callable[..., Heard], tmp_path: Path) -> None:
    WorkerStateFile(tmp_path / "drift.npz").save({"tracker": {"kind": "bank", "version": 1}, "answers": []})
    gone = work().next(WorkerGone)
    assert isinstance(gone, WorkerGone)
    assert "of another tracker" in gone.reason
    assert "remove the file" in gone.reason


def test_scans_are_registered_even_if_nothing_can_be_saved(
    work: Callable[..., Heard], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    heard = work()
    heard.next(Forecasted)
    (tmp_path / "drift.npz").mkdir()  # as good as a full disk
    for number in range(2):
        heard.registrar.take(job(number, 30, 30))
    heard.next(Registered, 2)
    (told,) = (record.message for record in caplog.records if "can't be saved" in record.message)
    assert "drift.npz" in told


def test_a_scan_out_of_order_is_refused_and_the_next_is_not(work: Callable[..., Heard]) -> None:
    heard = work()
    heard.registrar.take(job(5, 30, 30))
    heard.registrar.take(job(2, 30, 30))
    heard.registrar.take(job(6, 31, 30))
    refused = heard.next(NotRegistered)
    assert isinstance(refused, NotRegistered)
    assert refused.key == "2.nc 0"
    answer = heard.next(Registered, 2)
    assert isinstance(answer, Registered)
    assert answer.references == ["5.nc"]


def test_a_worker_ends_with_the_scheduler(work: Callable[..., Heard], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_process, "_FAREWELL_S", DEADLINE_S)  # or it is killed where the computer is busy
    # slow: one of two threads gets the exit code from the system, and the other must not return before it is stored
    exit_code = os.waitstatus_to_exitcode
    monkeypatch.setattr(os, "waitstatus_to_exitcode", lambda status: threading.Event().wait(0.2) or exit_code(status))
    heard = work()
    heard.next(Forecasted)
    ended = process()
    heard.registrar.close()
    assert ended.exitcode == 0


def test_worker_ends_with_a_killed_scheduler_even_while_it_registers(tmp_path: Path) -> None:
    """Otherwise it would write the state that the worker of the next scheduler reads."""
    program = """
        import logging, sys, threading
        from afspm.plugins.drift.frame.messages import StartWorker
        from afspm.plugins.drift.frame.settings import DriftCompensationSettings
        from afspm.plugins.drift.frame.worker_process import DriftWorkerProcess
        from tests.plugins.drift.test_drift_worker import Heard, job
        from afspm.plugins.drift.frame.messages import Registered

        worker = DriftWorkerProcess(
            DriftCompensationSettings(estimator="drift_parts.Hangs", tracker="paper"), None, logging.getLogger()
        )
        heard = Heard(worker)
        worker.take(StartWorker())
        worker.take(job(0, 30, 30))
        heard.next(Registered)
        worker.take(job(1, 33, 28))
        print(worker._process.pid, flush=True)
        threading.Event().wait()
    """
    command = [sys.executable, "-c", textwrap.dedent(program)]
    support = Path(deadlines.__file__).parent
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (Path(__file__).parent, support)))}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as scheduler:
        assert scheduler.stdout is not None
        worker = psutil.Process(int(scheduler.stdout.readline()))
        scheduler.kill()
        _, alive = psutil.wait_procs([worker], DEADLINE_S)
    assert not alive


def test_simulated_time_passes_again_when_a_hanging_worker_is_restarted(work: Callable[..., Heard]) -> None:
    heard = work()
    heard.next(Forecasted)
    held: list[str] = []

    @contextlib.contextmanager
    def late() -> Iterator[None]:
        held.append("held")
        yield
        held.append("passes")

    heard.registrar.late = late
    heard.registrar.take(job(0, 30, 30))
    heard.registrar.take(StartWorker())
    assert held == ["held", "passes"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process can't be forked here")
def test_restart_does_not_wait_for_processes_that_an_estimator_has_forked(
    work: Callable[..., Heard], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fifo = tmp_path / "forked"
    os.mkfifo(fifo)
    monkeypatch.setenv("FORKED", str(fifo))
    heard = work("Forks")
    heard.registrar.take(job(0, 30, 30))
    heard.next(Registered)
    former = psutil.Process(process().pid)
    heard.registrar.take(job(1, 33, 28))
    assert fifo.read_text(encoding="utf-8") == "forked"  # waits for the child
    (left,) = former.children()
    heard.registrar.take(StartWorker())
    assert left.status() != psutil.STATUS_ZOMBIE, "the restart has waited for its end"
    left.kill()
