"""Processes of a running experiment are killed and frozen, and its results are complete."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from systems import can_interrupt, interrupt
from tests.system.experiment.experiment_lab import (
    AfspmRun,
    Run,
    lasting,
    require_each_once,
    require_each_row_once,
)

from afspm.client.connect import connect
from afspm.model import ScopeState

QUICK = """
[restart]
beat_period = 0.25
missed_beats = 6
"""
MORE = """
[tip_classifier]
component = true
class = "TipClassifier"

[tip_corrector]
component = true
class = "TipCorrector"
workshop_center = ["8 um", "0 um"]
test_center = ["0 um", "4 um"]

[metadata]
component = true
class = "Metadata"
"""
# without the processor time of other processes a frozen step is detected by its limit alone
FROZEN = "no heartbeat|it is frozen" if sys.platform == "win32" else "no heartbeat"
EACH = ("recorder", "metadata", "tip_classifier", "tip_corrector", "microscope", "scheduler", "series")


def test_each_scan_is_taken_once_when_each_process_is_killed_in_turn(run: Run, tmp_path: Path) -> None:
    """While scanning, and between scans."""
    one = run(more=MORE + QUICK, over=lasting(tmp_path), scans=1000)
    one.wait_for("scan 1 of 1000")
    for times, state in ((2, "SCANNING"), (3, "FREE")):
        for name in EACH:
            one.wait_for_next(" witness ", f"state {state}")
            one.kill(name)
            one.wait_up(name, times)
    scans = one.end_lasting()
    require_each_once(one, scans)
    require_each_row_once(one, scans)
    for name in EACH:
        one.wait_for(f"{name} was restarted twice")


def test_each_scan_is_taken_once_when_a_frozen_process_is_replaced(run: Run, tmp_path: Path) -> None:
    one = run(more=QUICK, over=lasting(tmp_path), scans=1000)
    one.wait_for("scan 2 of 1000")
    for name in ("microscope", "scheduler", "series"):
        one.wait_for_next(" witness ", "state SCANNING")
        one.freeze(name)
        one.wait_for(f" {name} ", FROZEN)
        one.wait_up(name, times=2)
    require_each_once(one, one.end_lasting())


def test_each_scan_is_taken_once_when_all_processes_are_killed_at_once(run: Run, tmp_path: Path) -> None:
    one = run(more=MORE + QUICK, over=lasting(tmp_path), scans=1000)
    one.wait_for("scan 2 of 1000")
    one.wait_for_next(" witness ", "state SCANNING")
    for name in EACH:
        one.kill(name)
    one.wait_up("series", times=2)
    scans = one.end_lasting()
    require_each_once(one, scans)
    require_each_row_once(one, scans)


def test_process_that_dies_or_freezes_at_the_end_is_restarted_to_finish(run: Run) -> None:
    faults = {"dies": AfspmRun.kill, "freezes": AfspmRun.freeze}
    finishers = (f'[{name}]\ncomponent = true\nclass = "witness.Finisher"\n' for name in faults)
    one = run(more=QUICK + "".join(finishers))
    for name in faults:
        one.wait_for(f" {name} ", "finishing")
    one.wait_for(" afspm ", "the experiment has ended$")
    for name, fault in faults.items():
        fault(one, name)
    for name in faults:
        one.wait_for(f" {name} ", "restarting it, to finish")
    assert one.end() == 0, one.output
    for name in faults:
        assert (one.folder / f"{name} has finished.txt").exists(), one.output
    require_each_once(one, 4)


def test_process_frozen_at_the_last_scan_receives_that_scan_after_its_restart(run: Run, tmp_path: Path) -> None:
    """With default settings: the scheduler must stay longer than it takes to detect a frozen process."""
    more = f"""
[late]
component = true
class = "witness.Late"
scans = 2
begun = '{tmp_path / "late has begun.txt"}'
"""
    one = run(more=more, scans=2)
    assert one.end() == 0, one.output
    one.wait_for(" late ", "restarting it, to finish")
    assert (one.folder / "late has them all.txt").exists(), one.output


def test_experiment_ends_although_a_component_always_crashes(run: Run, tmp_path: Path) -> None:
    more = """
[hopeless]
component = true
heartbeats = false
command = ["python", "-c", "raise SystemExit('no hope')"]

[restart]
budget = 2
"""
    one = run(more=more, over=lasting(tmp_path), scans=1000)
    one.wait_for("CRITICAL gave up hopeless; the rest goes on")
    require_each_once(one, one.end_lasting())
    one.wait_for("hopeless was GIVEN UP")


SURVEY = """
from afspm import Component, Region


class Survey(Component):
    def run(self):
        scans = self.scope.scan(Region((0, 0), (5e-7, 5e-7)), shape=(8, 8))
        raise ValueError(f"{scans.first.values.std()} nm is too rough")
"""


@can_interrupt
def test_script_with_the_same_fault_twice_is_not_restarted_again(run: Run, tmp_path: Path) -> None:
    (tmp_path / "survey.py").write_text(SURVEY, encoding="utf-8")
    one = run(more='[survey]\ncomponent = true\nclass = "survey.Survey"\n', scans=1000)
    one.wait_for(
        "CRITICAL gave up survey; the rest goes on: failed twice in the same way",
        r"ValueError at survey.py:8",
        "`afspm restart survey` starts it again",
    )
    with connect(one.folder, "person") as scope:
        scope.restart("survey")
    one.wait_for("CRITICAL gave up survey", count=2)
    assert sum(" survey " in line and "started, process" in line for line in one.lines) == 4, one.output
    interrupt(one.process)
    one.end()


def test_run_without_a_translator_ends_and_logs_why(run: Run) -> None:
    one: AfspmRun = run(more="[restart]\nbudget = 0\n", scans=1000)
    one.wait_for("scan 1 of 1000")
    one.kill("microscope")
    assert one.end() == 1, one.output
    one.wait_for("CRITICAL gave up microscope; the experiment can't go on without it")


@pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
def test_experiment_with_a_hanging_disk_can_be_steered_and_ended(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, hook = tmp_path / "runs", Path(__file__).parents[2] / "support" / "hanging_disk"
    monkeypatch.setenv("PYTHONPATH", str(hook))
    monkeypatch.setenv("HANGING_FOLDER", str(runs))
    one = run(scans=10_000)
    one.wait_for("scan 2 of")
    with connect(one.folder, "Outside") as scope:
        switch = runs.with_name("runs.hangs")
        switch.touch()
        scope.flag("tip-shape-changed")
        assert scope.wait_until(lambda: scope.state is not ScopeState.SCANNING, timeout_s=DEADLINE_S)
        one.wait_for("WARNING", "the disk has not answered for 3 s")
        interrupt(one.process)
        one.end()
    switch.unlink()
