"""A component, or the run, ends while z is held: the feedback is on again, with the tip at the sample."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from systems import can_interrupt, interrupt, wait_until_gone
from tests.system.experiment.experiment_lab import AfspmRun

from afspm.storage.memory import Memory

MODULE = """
import os
from pathlib import Path

from afspm import Component
from afspm.basics import ControlLost, Refused


class Holder(Component):
    def run(self):
        mark = Path(__file__).with_name("once")
        if mark.exists():
            return
        try:
            with self.scope.hold_z("-200 pm", bias="1 mV", **self.bounds) as held:
                mark.touch()
                self.log.info("z is held")
                self.stay(held)
        except (ControlLost, Refused) as error:
            self.log.info("it ended: %s", error)
        mark.touch()

    bounds = {}

    def stay(self, held):
        self.scope.wait_until(lambda: False)


class Dying(Holder):
    def stay(self, held):
        os._exit(9)


class Flagging(Holder):
    def stay(self, held):
        self.scope.flag("tip-shape-changed")
        while True:
            held.read("x-current")
            self.scope.sleep(1.0)


class Wrong(Holder):
    def stay(self, held):
        held.move("-300 pm")


class Bounded(Holder):
    bounds = {"abort_current": "1e-15 A"}


class Solver(Component):
    solves = ("tip-shape-changed",)
    listens = ("ControlState",)

    def on_problem(self, problem, flagged):
        if flagged:
            with self.scope.control(solving="tip-shape-changed"):
                self.scope.set("scan-speed", "2 um/s")  # waits until the microscope is free
                self.log.info("the feedback is %s", self.scope.get("x-feedback-on"))
                self.scope.clear("tip-shape-changed")
"""
HOLDER = """
[control]
grace = "1 s"

[holder]
component = true
class = "holder.{kind}"

[limits.x-held-z-offset]
min = "-250 pm"
"""
SOLVER = """
[solver]
component = true
class = "holder.Solver"
"""


def values(run: AfspmRun) -> dict[str, Any]:
    """Return the values in force at the simulated microscope."""
    found: dict[str, Any] = Memory(run.folder / "state" / "microscope.json")["microscope"]["values"]
    return found


@pytest.mark.parametrize(
    ("kind", "lines"),
    [
        ("Dying", ("x-release-z is sent to the microscope, since ",)),
        ("Flagging", ("it ended: ", "the feedback is True")),
        ("Wrong", ("it ended: ", "below the lowest allowed")),
        ("Bounded", ("it ended: ", "z is held no more: x-current was")),
    ],
)
def test_hold_that_ends_early_leaves_the_feedback_on_and_the_tip_at_the_sample(
    run: Callable[..., AfspmRun], tmp_path: Path, kind: str, lines: tuple[str, ...]
) -> None:
    (tmp_path / "holder.py").write_text(MODULE, encoding="utf-8")
    one = run(more=HOLDER.format(kind=kind) + (SOLVER if kind == "Flagging" else ""), scans=4)
    assert one.end() == 0, one.output
    for line in lines:
        assert line in one.output, one.output
    assert "x-retract" not in one.output
    found = values(one)
    assert (found["x-feedback-on"], found["x-engaged"], found["tip-bias-voltage"]) == (True, True, 0.1)


@can_interrupt
def test_run_stopped_in_a_hold_ends_with_the_feedback_on(run: Callable[..., AfspmRun], tmp_path: Path) -> None:
    (tmp_path / "holder.py").write_text(MODULE, encoding="utf-8")
    one = run(more=HOLDER.format(kind="Holder"), scans=1000)
    one.wait_for(" holder ", "z is held")
    translator = {"the translator": one.pid("microscope")}
    interrupt(one.process)
    wait_until_gone(translator)
    assert one.end() == 130, one.output
    found = values(one)
    assert (found["x-feedback-on"], found["x-engaged"], found["tip-bias-voltage"]) == (True, True, 0.1)
