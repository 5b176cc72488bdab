"""The changelog is well formed, and so are the fragments that its next section is made of."""

from __future__ import annotations

import importlib
import re
import tomllib
from datetime import date
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("changelog")


def test_fragments_are_well_formed(tool: ModuleType) -> None:
    assert [error for file in tool.fragments(ROOT / "changes") for error in tool.errors(file)] == []


def test_groups_are_those_of_the_page(tool: ModuleType) -> None:
    page = (ROOT / "changes" / "README.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| `(\w+)` \| (.+?) \|$", page, re.MULTILINE)) == tool.GROUPS


def test_newest_version_is_the_version_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = re.findall(r"^## \[(.+?)\] - \d{4}-\d\d-\d\d$", CHANGELOG, re.MULTILINE)
    assert versions[0] == project["version"]


def test_items_are_one_line_each(tool: ModuleType) -> None:
    body = CHANGELOG.partition("\n## [")[2].splitlines()[1:]
    items = [line for line in body if line.startswith("- ")]
    assert len(items) > 50
    assert [line for line in items if not line.endswith(".") or len(line) > tool.LONGEST] == []
    assert [line for line in body if line.startswith(" ")] == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("film.movies.md", "- Export a film.\n"),
        ("film.md", "- Export a film.\n"),
        ("film.record.md", "Export a film.\n"),
        ("film.record.md", "- Export a film\n"),
        ("film.record.md", ""),
        ("film.record.md", f"- {'x' * 200}.\n"),
    ],
)
def test_malformed_fragment_is_refused(tool: ModuleType, tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert len(list(tool.errors(tmp_path / name))) == 1


def test_release_moves_fragments_into_the_changelog(tool: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "changes").mkdir()
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## [0.1.0] - 2026-11-24\n\n- First.\n", encoding="utf-8")
    for name, text in {"README.md": "page", "film.record.md": "- Film.\n", "a.drift.md": "- A.\n- B.\n"}.items():
        (tmp_path / "changes" / name).write_text(text, encoding="utf-8")
    project = tmp_path / "pyproject.toml"
    project.write_text('[project]\nversion = "0.1.0"\n', encoding="utf-8")
    with pytest.raises(SystemExit, match=r"has version 0\.1\.0 already; raise that of"):
        tool.main(date(2027, 3, 1), tmp_path)
    project.write_text('[project]\nversion = "0.2.0"\n', encoding="utf-8")
    tool.main(date(2027, 3, 1), tmp_path)
    assert (tmp_path / "CHANGELOG.md").read_text(encoding="utf-8") == (
        "# Changelog\n\n## [0.2.0] - 2027-03-01\n\n### Drift\n\n- A.\n- B.\n\n### Record\n\n- Film.\n\n"
        "## [0.1.0] - 2026-11-24\n\n- First.\n"
    )
    assert [file.name for file in (tmp_path / "changes").iterdir()] == ["README.md"]
    with pytest.raises(SystemExit, match="no fragments"):
        tool.main(date(2027, 4, 1), tmp_path)
