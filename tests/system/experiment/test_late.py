"""A simulated night on a slow computer loses nothing, since its clock waits."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import Run

import afspm
from afspm.model import ControlRequest
from afspm.record.report import write

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
import threading

from afspm import Component


class Judge(Component):
    flags = ("tip-shape-changed",)

    def on_scan(self, scan):
        if scan.time_ns >= self.memory.setdefault("last_ns", scan.time_ns) + 3_300_000_000_000:
            threading.Event().wait(1.2)  # the series ends the experiment meanwhile
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
