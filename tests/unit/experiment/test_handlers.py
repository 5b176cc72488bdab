"""Handlers that would never be called, or can't be, are findings of the check."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.experiment import load

from .conftest import FRAME

COMPONENT = """
from afspm import Component
class Mine(Component):
    def {method}:
        pass
    def helper(self):
        pass
"""
TABLE = '[mine]\ncomponent = true\nclass = "mine.Mine"\n'


def findings(folder: Path, method: str, more: str = "") -> list[str]:
    (folder / "mine.py").write_text(COMPONENT.format(method=method))
    (folder / "experiment.toml").write_text(more + FRAME + TABLE)
    return [
        f"{finding.level.value}: {finding.what} {finding.hint}" for finding in load(folder / "experiment.toml").check()
    ]


@pytest.mark.parametrize(
    "method",
    ["on_scan(self, scan)", "on_scan(self, scan, more=1)", "on_tick(self)", "run(self)", "on_action_msg(self, m)"],
)
def test_valid_handler_has_no_finding(tmp_path: Path, method: str) -> None:
    assert findings(tmp_path, method) == []


def test_handler_that_is_never_called_is_a_warning(tmp_path: Path) -> None:
    (told,) = findings(tmp_path, "on_scans(self, scan)")
    assert told.startswith("warning: [mine] Mine.on_scans is never called")
    assert "'on_scan'" in told


def test_user_message_may_have_a_handler(tmp_path: Path) -> None:
    (tmp_path / "crystal.proto").write_text('syntax = "proto3"; message PeakList { double height = 1; }')
    assert findings(tmp_path, "on_peak_list(self, message)", 'messages = ["crystal.proto"]\n') == []


@pytest.mark.parametrize("method", ["on_scan(scan)", "on_scan(self)", "on_problem(self, problem)", "run(self, scope)"])
def test_handler_with_a_wrong_signature_is_an_error(tmp_path: Path, method: str) -> None:
    (told,) = findings(tmp_path, method)
    assert told.startswith("error: [mine] Mine.")
    assert "write `def " in told


@pytest.mark.parametrize(("old", "new"), [("def on", "async def on"), ("pass", "yield scan")])
def test_async_or_generator_handler_is_an_error(tmp_path: Path, old: str, new: str) -> None:
    (tmp_path / "mine.py").write_text(COMPONENT.format(method="on_scan(self, scan)").replace(old, new, 1))
    (tmp_path / "experiment.toml").write_text(FRAME + TABLE)
    (error,) = load(tmp_path / "experiment.toml").check()
    assert "async function or a generator" in error.what
