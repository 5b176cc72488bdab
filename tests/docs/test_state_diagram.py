"""The state diagram of control in the documentation."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from afspm.scheduler.control.arbitration import ArbitrationState

ROOT = Path(__file__).parents[2]


def test_state_diagram_is_drawn_from_the_arbitration_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    diagram = importlib.import_module("state_diagram")
    drawn = diagram.edges()
    assert ("free", "asks for control", "in control") in drawn
    assert ("in control", "flags a problem", "flagged, no component in control") in drawn
    assert ("flagged, no component in control", "asks for control", "solver in control") in drawn
    assert ("solver in control", "the last flag is removed", "free") in drawn
    assert not any(before == "manual" and after == "in control" for before, _, after in drawn)
    assert diagram.mermaid().startswith("stateDiagram-v2")
    assert diagram.kind(ArbitrationState()) == "free"
