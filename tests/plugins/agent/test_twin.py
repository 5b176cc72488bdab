"""The simulated run of a plan."""

from __future__ import annotations

from pathlib import Path

from afspm.plugins.agent.plan import read_plan
from afspm.plugins.agent.twin import simulate

SCAN = {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["500 nm", "500 nm"], "pixels": [8, 8]}


def test_harmless_plan_changes_no_tip(tmp_path: Path) -> None:
    found = simulate(read_plan({"title": "look", "steps": [SCAN]}), {}, 1e-6, tmp_path)
    assert found["harm"]["tip_changes"] == 0
    assert found["seconds"] > 7.9
