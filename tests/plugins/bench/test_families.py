"""Judges of single tasks, on made evidence."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.plugins.bench.evidence_made import MadeEvidence, scan_row

from afspm.plugins.bench.evidence import Report
from afspm.plugins.bench.tasks import task_of
from afspm.simulation import World

TASK = task_of("night/calm", 12)
CALM_AFTER_S = 1800.0 * math.log(
    float(np.hypot(*TASK.microscope["drift"]["relaxing"][0]["total_m"][:2])) / 1800.0 / 15e-12
)


def judged(minutes: float) -> tuple[bool, tuple[str, ...]]:
    rows = [scan_row(1, minutes)]
    evidence = MadeEvidence(report=Report("done", {}, (rows[0].time_ns,)), scans=rows)
    settings = {name: TASK.microscope[name] for name in ("surface", "drift")}
    evidence.__dict__["world"] = World.from_settings(settings, 1, 0.0)
    ruling = TASK.judge(evidence)
    return ruling.solved, ruling.why


@pytest.mark.parametrize(("after_s", "solved"), [(-600.0, False), (120.0, True), (3000.0, True), (4200.0, False)])
def test_scan_at_rest_must_be_calm_and_in_time(after_s: float, solved: bool) -> None:
    assert judged((CALM_AFTER_S + after_s) / 60.0)[0] is solved


def test_scan_at_the_very_start_is_judged() -> None:
    solved, why = judged(0.6)
    assert not solved
    assert "was taken at" in why[0]
