"""A run without any plan left ends, with an exit code of its own."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.model import ControlMode

NOTIFY = """
[notify]
command = ["python", "-c", "import sys; open({file!r}, 'a').write(sys.stdin.read() + chr(10))"]
on = ["end", "given-up"]
"""
DRAWN = '[night_picture]\ncomponent = true\nclass = "NightPicture"\n'
ROUGH = """
from afspm import Component


class Rough(Component):
    def __init__(self, **settings): ...

    def run(self):
        self.scope.scan(shape=(8, 8))
        raise ValueError("too rough")
"""


def notified(file: Path) -> list[str]:
    return [json.loads(line)["what"] for line in file.read_text(encoding="utf-8").splitlines()]


def test_run_with_a_finished_series_ends_like_an_announced_end(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    calls = tmp_path / "calls.jsonl"
    one: AfspmRun = run("--without", "witness", more=DRAWN + NOTIFY.format(file=calls.as_posix()), scans=2)
    assert one.end() == 3, one.output
    assert one.facts()["how"] == "plans_done"
    assert 10.0 < one.facts()["real_s"] < 300.0
    assert "nothing was left to run: series is done" in one.output
    assert (one.folder / "night.png").exists(), "components finish what they have to"
    assert notified(calls) == ["end"]
    assert not re.search(r"(ERROR|CRITICAL) ", one.output), one.output


def test_run_with_its_only_plan_given_up_ends_and_can_be_resumed(run: Run, afspm_run: Run, tmp_path: Path) -> None:
    (tmp_path / "rough.py").write_text(ROUGH, encoding="utf-8")
    calls = tmp_path / "calls.jsonl"
    over = '[series]\nclass = "rough.Rough"\n' + NOTIFY.format(file=calls.as_posix())
    one: AfspmRun = run("--without", "witness", over=over)
    assert one.end() == 4, one.output
    assert one.facts()["how"] == "plans_lost"
    assert "nothing is left to run: series was given up" in one.output
    assert "series was GIVEN UP" in one.output
    assert "given-up" in notified(calls)
    (tmp_path / "rough.py").write_text(ROUGH.replace('raise ValueError("too rough")', "self.scope.end_experiment()"))
    again = afspm_run("--resume", str(one.folder), "--no-report")
    assert again.end() == 0, again.output


def test_a_run_in_manual_mode_does_not_end(run: Run) -> None:
    one: AfspmRun = run("--without", "witness", more='[control.roles]\nend_experiment = ["series"]\n', scans=1)
    one.wait_up("scheduler", 1)
    with afspm.connect(one.folder) as scope:  # joined before: the run ends ten seconds after the series
        one.wait_for("series .*scan 1")
        scope.set_mode(ControlMode.MANUAL)
        one.wait_for("the experiment goes on as long as it is in use: the mode is MANUAL")
        scope.set_mode(ControlMode.AUTOMATED)
    assert one.end() == 3, one.output
