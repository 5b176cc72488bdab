"""A component, or the run, dies with the feedback off: the tip is retracted, and measurements wait for a person."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from systems import can_interrupt, interrupt, wait_until_gone
from tests.system.experiment.experiment_lab import AfspmRun, require_each_once

import afspm
from afspm.storage.memory import Memory

MODULE = """
import os
from pathlib import Path

from afspm import Component


class Reckless(Component):
    def run(self):
        mark = Path(__file__).with_name("once")
        if mark.exists():
            return
        with self.scope.control():
            self.scope.set("x-feedback-on", "false")
            mark.touch()
            self.leave_it_so()

    def leave_it_so(self):
        os._exit(9)


class Faulty(Reckless):
    def leave_it_so(self):
        self.scope.set("tip-bias-voltage", "1 kV")


class Waiting(Reckless):
    def run(self):
        super().run()
        for event in self.scope.events("Scan2d"):
            self.log.info("a scan")


class Blind(Reckless):
    def leave_it_so(self):
        self.log.info("the feedback is off")
        self.scope.wait_until(lambda: False)


class Doctor(Component):
    solves = ("device-malfunction",)
    listens = ("ControlState",)

    def on_problem(self, problem, flagged):
        if not flagged:
            return
        with self.scope.control(solving="device-malfunction"):
            self.scope.action("x-engage")
            self.scope.set("x-feedback-on", "true")
            self.scope.clear("device-malfunction")
            Path(__file__).with_name("cleared").touch()
"""
PARTS = """
[control]
grace = "1 s"
idle = "stay"

[reckless]
component = true
class = "danger.{kind}"
"""
DOCTOR = """
[doctor]
component = true
class = "danger.Doctor"
"""

BLIND = """
[control]
retract = {retract}

[blind]
component = true
class = "danger.Blind"
"""
RETRACTED = "the feedback off: the tip was retracted"


def engaged(run: AfspmRun) -> bool:
    """Return whether the translator left the tip at the surface."""
    return bool(Memory(run.folder / "state" / "microscope.json")["microscope"]["values"]["x-engaged"])


@pytest.mark.parametrize("kind", ["Reckless", "Faulty", "Waiting"])
def test_tip_left_in_danger_is_retracted_and_blocks_measurements_until_cleared(
    run: Callable[..., AfspmRun], tmp_path: Path, kind: str
) -> None:
    (tmp_path / "danger.py").write_text(MODULE, encoding="utf-8")
    # a busy computer may start the reckless one after the last scan: the run goes on until the doctor has cleared
    over = f"[witness]\nuntil = {json.dumps(str(tmp_path / 'cleared'))}\n"
    one = run(more=PARTS.format(kind=kind) + DOCTOR, over=over, scans=6, speed=60.0)
    assert one.end() == 0, one.output
    steps = [  # all of them lines of the scheduler: lines of two processes may be printed in another order
        "x-retract is sent to the microscope, since ",
        "x-retract: done",
        "scheduler flagged device-malfunction",
        "doctor cleared device-malfunction",
    ]
    found = [one.output.index(step) for step in steps]
    assert found == sorted(found), one.output
    assert one.output.count("x-retract: done") == 1
    with afspm.open_run(one.folder) as record:
        (problem,) = record.problems.where(lambda row: row.name == "device-malfunction")
        flagged_ns, cleared_ns = problem.flagged_ns, problem.cleared_ns
        assert cleared_ns is not None
        during = record.scans.where(lambda row: flagged_ns <= (row.began_ns or 0) < cleared_ns)
    assert not during, one.output
    require_each_once(one, 6)


@pytest.mark.parametrize(("killed", "retract"), [pytest.param(False, False, marks=can_interrupt), (True, True)])
def test_tip_is_retracted_at_an_end_with_feedback_off_unless_the_file_forbids_it(
    run: Callable[..., AfspmRun], tmp_path: Path, killed: bool, retract: bool
) -> None:
    (tmp_path / "danger.py").write_text(MODULE, encoding="utf-8")
    one = run(more=BLIND.format(retract=str(retract).lower()), scans=1000)
    one.wait_for(" blind ", "the feedback is off")
    translator = {"the translator": one.pid("microscope")}
    if killed:
        one.process.kill()
    else:
        interrupt(one.process)
    wait_until_gone(translator)
    assert engaged(one) is not retract
    if not killed:  # no scheduler is left for the report
        assert one.end() == 130, one.output
        assert RETRACTED not in one.output


@can_interrupt
def test_run_with_the_tip_retracted_by_ctrl_c_resumes_once_the_flag_is_cleared(
    run: Callable[..., AfspmRun], afspm_run: Callable[..., AfspmRun], tmp_path: Path
) -> None:
    (tmp_path / "danger.py").write_text(MODULE, encoding="utf-8")
    more = BLIND.format(retract="true") + DOCTOR
    one = run(more=more, scans=1000)
    one.wait_for(" blind ", "the feedback is off")
    interrupt(one.process)
    assert one.end() == 130, one.output
    assert RETRACTED in one.output
    assert not engaged(one)
    again = afspm_run("--resume", str(one.folder))
    steps = ("scheduler flagged device-malfunction", "doctor cleared", "series is in control")
    for step in steps:
        again.wait_for(" scheduler ", step)
    found = [again.output.index(step) for step in steps]
    assert found == sorted(found), again.output
