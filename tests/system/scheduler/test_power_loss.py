"""The power fails right after a problem was published: the problem is still flagged after the restart."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

from afspm import wire
from afspm.model import ControlRequest, Problem

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
LOSSY = Path(__file__).parents[2] / "support" / "lossy_disk"
FLAGS = (Problem.TIP_SHAPE_CHANGED, Problem.FEEDBACK_NON_OPTIMAL, Problem.DEVICE_MALFUNCTION)


def test_published_problem_is_still_flagged_after_a_power_cut(
    rig: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / "state"
    state.mkdir()
    monkeypatch.setenv("PYTHONPATH", str(LOSSY))
    monkeypatch.setenv("LOSSY_FOLDER", str(state))
    shadow = runpy.run_path(str(LOSSY / "sitecustomize.py"))["Shadow"](str(state))
    rig.class_ = "patient_scheduler.PatientScheduler"
    rig.start()
    for number, flag in enumerate(FLAGS, start=1):
        component = rig.component(f"Component {number}")
        assert component.ask(ControlRequest.ADD_EXP_PRBLM, int(flag)).ok
        rig.kill()
        shadow.restore()
        rig.start()
        late = rig.component(f"Late {number}")
        found = wire.decode("ControlState", rig.until(lambda late=late: late.packets("ControlState"))[-1][1])
        assert set(found.problems) == set(map(int, FLAGS[:number]))
