"""The check of a release finds a wrong tag, a file that is missing, and a file that does not belong."""

from __future__ import annotations

import importlib
import re
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
LISTED: dict[str, Any] = {
    "suffixes": [".py", ".pyi"],
    "left_out": ["quality.toml"],
    "folders": {"src/lab": "lab", "proto": "lab/proto", "LICENSE": "LICENSE"},
    "made": {"lab/generated": ["{proto}_pb2.py"], "lab-{version}.dist-info": ["RECORD"]},
}
TRACKED = ["src/lab/a.py", "src/lab/quality.toml", "src/laboratory/b.py", "LICENSE", "tests/test_a.py"]
WHOLE = ["lab/a.py", "LICENSE", "lab-1.0.dist-info/RECORD"]


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("release_check")


def test_whole_distribution_has_no_fault(tool: ModuleType) -> None:
    listed = {**LISTED, "suffixes": [".py", ""]}
    assert list(tool.faults(listed, TRACKED, WHOLE, "1.0")) == []


def test_missing_foreign_and_doubled_files_are_faults(tool: ModuleType) -> None:
    found = ["lab/a.py", "lab/a.py", "lab/quality.toml", "LICENSE", "lab/__pycache__/a.pyc", "build/site/index.html"]
    listed = {**LISTED, "suffixes": [".py", ""]}
    assert list(tool.faults(listed, TRACKED, found, "1.0")) == [
        "missing: lab-1.0.dist-info/RECORD",
        "not in the list: build/site/index.html",
        "not in the list: lab/__pycache__/a.pyc",
        "not in the list: lab/quality.toml",
        "2 times: lab/a.py",
    ]


def test_tracked_file_of_an_unlisted_kind_is_a_fault(tool: ModuleType) -> None:
    assert list(tool.faults(LISTED, TRACKED, WHOLE, "1.0")) == ["a file of a kind that is not in the list: LICENSE"]


def test_message_without_its_class_is_a_fault(tool: ModuleType) -> None:
    listed = {**LISTED, "suffixes": [".py", ".proto", ""]}
    tracked = [*TRACKED, "proto/scan.proto"]
    faults = tool.faults(listed, tracked, [*WHOLE, "lab/proto/scan.proto"], "1.0")
    assert list(faults) == ["missing: lab/generated/scan_pb2.py"]


def test_tag_agrees_with_version_and_changelog(tool: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "changes").mkdir()
    changelog = tmp_path / "CHANGELOG.md"
    changelog.write_text("# Changelog\n\n## [0.2.0] - 2027-01-01\n\n## [0.1.0] - 2026-11-25\n", encoding="utf-8")
    tool.check_tag("v0.2.0", "0.2.0", tmp_path)
    with pytest.raises(tool.Failed, match=r"the tag is v0\.2\.0, and pyproject\.toml has version 0\.1\.0"):
        tool.check_tag("v0.2.0", "0.1.0", tmp_path)
    with pytest.raises(tool.Failed, match=r"no section of 0\.3\.0"):
        tool.check_tag("v0.3.0", "0.3.0", tmp_path)
    (tmp_path / "changes" / "late.record.md").write_text("- Read it.\n", encoding="utf-8")
    with pytest.raises(tool.Failed, match=r"1 fragments are in changes/, late\.record\.md first"):
        tool.check_tag("v0.2.0", "0.2.0", tmp_path)


def test_lock_has_the_version_of_the_package() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    locked = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]
    assert [one["version"] for one in locked if one["name"] == "afspm"] == [version]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda file: file.stem)
def test_each_permission_to_write_needs_the_consent_of_the_owner(workflow: Path) -> None:
    text = workflow.read_text(encoding="utf-8")
    assert re.search(r"^permissions: \{\}$", text, re.MULTILINE)
    jobs = re.split(r"^  (?=[\w-]+:$)", text.partition("\njobs:\n")[2], flags=re.MULTILINE)[1:]
    assert jobs
    for job in jobs:
        if re.search(r": write\b|pypi-publish|secrets\.", job):
            assert re.search(r"^    if: vars\.AFSPM_PUBLISH == 'yes'$", job, re.MULTILINE), job
