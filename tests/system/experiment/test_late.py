"""A simulated night on a slow computer loses nothing, since its clock waits."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import psutil
import pytest
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.model import ControlRequest
from afspm.report.night_report import write

NIGHT = """
[clock]
speed = 600.0
waits = {waits}

[microscope]
component = true
class = "Simulator"
surface = "flat"
initial = {{ scan-speed = "40 um/s" }}
faults = [{{ kind = "late-reply", count = 1000, duration_s = 0.9 }}]  # real seconds: nine minutes of the experiment

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [16, 16]
every = "10 min"
duration = "1 h"
keep_control = true
end_when_done = true
"""


@pytest.mark.parametrize("waits", [True, False])
def test_scans_are_missed_only_if_the_clock_does_not_wait(afspm_run: Run, tmp_path: Path, waits: bool) -> None:
    file = tmp_path / "night.toml"
    file.write_text(NIGHT.format(waits=str(waits).lower()), encoding="utf-8")
    one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    with afspm.open_run(one.folder) as record:
        assert (len(record.scans) == 7) is waits, one.output


LATE = 'faults = [{{ kind = "late-reply", count = 1000, duration_s = 0.9 }}]'


@contextlib.contextmanager
def starved(run: AfspmRun, *names: str) -> Iterator[None]:
    """Let processes of a run work only a tenth of the time, as on a computer under a load of twenty."""
    is_over = threading.Event()

    def work() -> None:
        while not is_over.is_set():
            with contextlib.suppress(psutil.Error, AssertionError):  # between two lives
                processes = [psutil.Process(run.pid(name)) for name in names]
                for process in processes:
                    process.suspend()
                is_over.wait(0.9)
                for process in processes:
                    process.resume()
            is_over.wait(0.1)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@pytest.mark.slow
def test_starved_processes_miss_no_scan(afspm_run: Run, tmp_path: Path) -> None:
    file = tmp_path / "night.toml"
    file.write_text(NIGHT.replace(LATE, "").format(waits="true"), encoding="utf-8")
    one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
    one.wait_for("series is in control")
    with starved(one, "microscope", "scheduler", "series"):
        assert one.end() == 0, one.output
    with afspm.open_run(one.folder) as record:
        assert len(record.scans) == 7, one.output


DRIFT = (
    NIGHT.replace(LATE, "")
    .replace('"Scheduler"', '"DriftCompensatedScheduler"\ndrift = {{ estimator = {{ class = "patient.Patient" }} }}')
    .replace('duration = "1 h"', "scans = 3")
    + """
[control]
solved_by_hand = ["thermal-drift", "device-malfunction"]
"""
)
PATIENT = """
import threading

import numpy as np

from afspm.plugins.drift.registration import Registration


class Patient:
    def register(self, reference, scan, prior=None):
        threading.Event().wait(12.0)
        center_m = np.array(reference.region.center_m)
        return Registration(True, "", np.zeros(2), np.eye(2) * 1e-20, np.zeros((2, 2)), center_m)
"""


@pytest.mark.slow
def test_registrations_longer_than_ten_seconds_keep_the_planned_times(afspm_run: Run, tmp_path: Path) -> None:
    (tmp_path / "patient.py").write_text(PATIENT, encoding="utf-8")
    file = tmp_path / "night.toml"
    file.write_text(DRIFT.format(waits="true"), encoding="utf-8")
    one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    with afspm.open_run(one.folder) as record:
        times_s = [scan.time_ns / 1e9 for scan in record.scans]
    assert len(times_s) == 3, one.output
    assert max(after_s - before_s for before_s, after_s in pairwise(times_s)) < 900.0, (times_s, one.output)


HOLDER = """
import threading

from afspm import Component


class Holder(Component):
    def on_scan(self, scan):
        if not self.memory.setdefault("held", False):
            self.memory["held"] = True
            self.memory.save()
            with self.clock.late():
                self.log.info("holding the time")
                threading.Event().wait()
"""


def test_component_killed_while_time_waits_for_it_does_not_stop_the_night(afspm_run: Run, tmp_path: Path) -> None:
    (tmp_path / "holder.py").write_text(HOLDER, encoding="utf-8")
    file = tmp_path / "night.toml"
    night = NIGHT.replace(LATE, "").format(waits="true")
    file.write_text(night + '[holder]\ncomponent = true\nclass = "holder.Holder"\n', encoding="utf-8")
    one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
    one.wait_for("holder .*holding the time")
    one.kill("holder")
    assert one.end() == 0, one.output  # an hour at real speed would exceed every deadline
    with afspm.open_run(one.folder) as record:
        assert len(record.scans) == 7, one.output


JUDGED = (
    NIGHT.replace('faults = [{{ kind = "late-reply", count = 1000, duration_s = 0.9 }}]', "")
    + """
[judge]
component = true
class = "judge.Judge"

[control]
solved_by_hand = ["tip-shape-changed"]
"""
)
JUDGE = """
from contextlib import suppress

from afspm import Component
from afspm.basics.errors import ExperimentEnded


class Judge(Component):
    flags = ("tip-shape-changed",)

    def on_scan(self, scan):
        if scan.time_ns >= self.memory.setdefault("last_ns", scan.time_ns) + 3_300_000_000_000:
            with suppress(ExperimentEnded):  # by the series
                self.scope.wait_until(lambda: False)
            self.scope.flag("tip-shape-changed")
"""


def test_tip_change_detected_after_the_end_is_in_the_report(afspm_run: Run, tmp_path: Path) -> None:
    (tmp_path / "judge.py").write_text(JUDGE, encoding="utf-8")
    file = tmp_path / "night.toml"
    file.write_text(JUDGED.format(waits="true"), encoding="utf-8")
    one = afspm_run(str(file), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    with afspm.open_run(one.folder) as record:
        flags = [entry for entry in record.journal if entry.request == ControlRequest.ADD_EXP_PRBLM]
    assert {(flag.who, flag.refused) for flag in flags} == {("judge", True)}
    assert "tip-shape-changed seen after the end" in write(one.folder).read_text(encoding="utf-8")
