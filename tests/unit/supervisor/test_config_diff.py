"""A run is not resumed by the name of a file that has changed since."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from afspm.basics.errors import ConfigError
from afspm.experiment import load
from afspm.supervisor import resume
from afspm.supervisor.own_runs import HOMES
from afspm.supervisor.resume import differing
from afspm.supervisor.run import FILES

NIGHT = """
[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"

[limits]
region = { x = ["-1 um", "1 um"], y = ["-1 um", "1 um"] }
"""
OVERLAY = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
"""


@pytest.fixture
def night(tmp_path: Path) -> Path:
    """An experiment file, with an overlay, whose run was cut off."""
    file, overlay = tmp_path / "night.toml", tmp_path / "series.toml"
    file.write_text(NIGHT, encoding="utf-8")
    overlay.write_text(OVERLAY, encoding="utf-8")
    begun = load(file, overlay)
    begun.require_valid()
    run = tmp_path / "runs" / "night-1"
    (run / "state").mkdir(parents=True)
    (run / "experiment.toml").write_text(begun.expanded(), encoding="utf-8")
    facts = {"name": "night", HOMES: [str(tmp_path)], FILES: [str(name) for name in begun.files]}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    return file


def test_run_is_found_by_its_unchanged_files(night: Path) -> None:
    assert resume.find(night).folder == night.parent / "runs" / "night-1"
    night.write_text("# reading it again\n" + NIGHT.replace("60.0", "6e1"), encoding="utf-8")
    assert resume.find(night).folder == night.parent / "runs" / "night-1"


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ('x = ["-1 um", "1 um"]', 'x = ["-100 nm", "100 nm"]', r"\[limits\] region"),
        ("[limits]", "[limits]\nscan-speed = ['0 um/s', '1 um/s']", r"\[limits\] scan-speed"),
        ("60.0", "120.0", r"\[clock\] speed"),
        ("[limits]", "[notify]\ncommand = ['call']\n[limits]", r"\[notify\] is new"),
        ("[limits]", "[lmits]", r"\[limits\] is gone"),
    ],
)
def test_edited_file_is_refused_with_a_remedy(night: Path, before: str, after: str, said: str) -> None:
    night.write_text(NIGHT.replace(before, after), encoding="utf-8")
    with pytest.raises(ConfigError, match=said) as refused:
        resume.find(night)
    assert f"`afspm run --resume {night.parent / 'runs' / 'night-1'}` goes on without" in refused.value.hint
    assert f"`afspm run {night} {night.parent / 'series.toml'}` begins a new run" in refused.value.hint


def test_edited_overlay_is_refused_too(night: Path) -> None:
    (night.parent / "series.toml").write_text(OVERLAY.replace("1 um", "5 um"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"\[series\] size"):
        resume.find(night)


def test_missing_overlay_is_refused(night: Path) -> None:
    (night.parent / "series.toml").unlink()
    with pytest.raises(ConfigError, match=r"\[series\] is gone"):
        resume.find(night)


def test_run_named_by_its_folder_resumes_with_its_original_file(night: Path) -> None:
    night.write_text(NIGHT.replace("1 um", "100 nm"), encoding="utf-8")
    found = resume.find(night.parent / "runs" / "night-1")
    assert "100 nm" not in found.experiment.expanded()


def test_differences_are_named() -> None:
    before = {"name": "a", "limits": {"z": 1, "region": 2}, "old": {"component": True}, "same": {"x": 1}}
    now = {"name": "b", "limits": {"z": 2, "region": 2, "current": 3}, "same": {"x": 1}, "new": {"component": True}}
    assert differing(before, now) == ["name", "[limits] z, current", "[old] is gone", "[new] is new"]
