"""A component dies with the feedback off: the tip is retracted, and nobody measures until somebody has seen to it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from experiment_lab import AfspmRun, require_each_once

MODULE = """
import os
from pathlib import Path

from afspm import Component


class Reckless(Component):
    def run(self):
        mark = Path(__file__).with_name("died")
        if mark.exists():
            return
        with self.scope.control():
            self.scope.set("x-feedback-on", "false")
            mark.touch()
            os._exit(9)


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
"""
PARTS = """
[control]
grace = "1 s"

[reckless]
component = true
class = "danger.Reckless"

[doctor]
component = true
class = "danger.Doctor"
"""


def test_a_tip_that_was_left_in_danger_is_retracted_and_nobody_measures_before_it_was_seen_to(
    run: Callable[..., AfspmRun], tmp_path: Path
) -> None:
    (tmp_path / "danger.py").write_text(MODULE, encoding="utf-8")
    one = run(more=PARTS, scans=6, speed=60.0)
    assert one.end() == 0, one.output
    steps = [
        "x-retract is sent to the microscope, since ",
        "x-retract: done",
        "device-malfunction is flagged by scheduler",
        "device-malfunction is cleared by doctor",
    ]
    found = [one.output.index(step) for step in steps]
    assert found == sorted(found), one.output
    assert "state SCANNING" not in one.output[found[1] : found[3]]
    require_each_once(one, 6)
