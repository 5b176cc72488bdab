"""Each target of the Makefile runs at every change, in the nightly or in turn, or is left out with a reason."""

from __future__ import annotations

import importlib
import re
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("targets")


def text(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def prerequisites(target: str) -> set[str]:
    return set(re.findall(rf"^{target}:(.*)$", text("Makefile"), re.MULTILINE)[0].split())


def run_by(file: str) -> set[str]:
    """Return the targets that a script names, with the targets that these consist of."""
    named = {*re.findall(r"\bmake ([a-z][a-z-]*)", re.sub(r"(?m)^#.*", "", text(file)))}
    named.update(*(listed.split() for listed in re.findall(r"for target in (.*); do", text(file))))
    return named | {part for target in named for part in prerequisites(target)}


def commands(*arguments: str) -> str:
    """Return the commands that make would run."""
    command = ["make", "--dry-run", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=True).stdout


def test_each_target_runs_somewhere_or_says_why_not(tool: ModuleType) -> None:
    targets = {one for line in re.findall(r"^\.PHONY: (.*)$", text("Makefile"), re.MULTILINE) for one in line.split()}
    declared = set(re.findall(r"^([a-z][a-z-]*):(?!=)", text("Makefile"), re.MULTILINE))
    assert declared == targets, "all are .PHONY"
    change, nightly, left_out = run_by(".ci/run"), run_by(".ci/nightly"), set(tool.LEFT_OUT)
    unseen = targets - change - nightly - left_out
    assert not unseen, f"add {unseen} to .ci/run or .ci/nightly, or to LEFT_OUT of tools/targets.py with the reason"
    assert left_out <= targets, "LEFT_OUT names targets of the Makefile"
    assert not left_out & change


def test_each_target_of_the_nightly_alone_is_in_turn_or_says_why_not(tool: ModuleType) -> None:
    seen = run_by(".ci/run") | set(tool.IN_TURN) | set(tool.NOT_IN_TURN) | set(tool.LEFT_OUT)
    missing = {target for target in run_by(".ci/nightly") if target[0].isalpha()} - seen
    assert not missing, f"add {missing} to IN_TURN or NOT_IN_TURN of tools/targets.py"
    assert not set(tool.IN_TURN) & set(tool.NOT_IN_TURN)


def test_each_target_has_its_turn(tool: ModuleType) -> None:
    found = {tool.in_turn(number) for number in range(len(tool.IN_TURN))}
    assert {one.partition(" ")[0] for one in found} == set(tool.IN_TURN)
    assert "chaos NIGHTS=4" in found


@pytest.mark.skipif(shutil.which("make") is None, reason="no make is found")
@pytest.mark.parametrize(("setting", "is_quick"), [("", False), ("EIGHTH=1", True)])
def test_drift_is_judged_by_all_pairs_unless_an_eighth_is_asked_for(setting: str, is_quick: bool) -> None:  # claims F13
    printed = commands("bench-drift", *setting.split())
    assert "benchmarks.drift" in printed
    assert ("--quick" in printed) == is_quick


@pytest.mark.skipif(shutil.which("make") is None, reason="no make is found")
def test_nights_are_replayed_by_their_own_number() -> None:
    assert "--nights 200 " in commands("replay-nights")
    assert "--nights 40 " in commands("replay-nights", "NIGHTS=40")
    assert "--nights 20 " in commands("chaos")
