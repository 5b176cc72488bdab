"""What `make docs` adds to the pages: navigation, version, repository, drawings for a light and a dark scheme."""

from __future__ import annotations

import importlib
import json
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
HOW_TO = ["How to: measure", "How to: watch", "How to: after the night", "How to: extend"]


@pytest.fixture
def builder(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("build_docs")


def test_how_to_pages_stand_in_four_groups(builder: ModuleType) -> None:
    sections = tomllib.loads(f"nav = {builder._nav()}")["nav"][1:]
    groups = {title: pages for section in sections for title, pages in section.items()}
    assert list(groups) == ["Tutorials", *HOW_TO, "Reference", "Explanation"]
    shown = [page for title in HOW_TO for page in groups[title] if not page.startswith("packages/")]
    pages = [f"docs/how-to/{page.name}" for page in (ROOT / "docs/how-to").glob("*.md")]
    assert sorted(shown) == sorted(["CONTRIBUTING.md", *pages])


def test_every_page_shows_the_version(builder: ModuleType) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    about = tomllib.loads(builder._about())
    assert about["site_name"] == about["copyright"] == f"afspm {version}"


@pytest.mark.parametrize(
    ("declared", "origin", "linked"),
    [
        ("https://forge.example/afspm", "https://elsewhere.example/afspm", "https://forge.example/afspm"),
        ("", "https://forge.example/lab/afspm.git", "https://forge.example/lab/afspm.git"),
        ("", "/home/ada/afspm", None),
    ],
)
def test_repository_link_comes_from_the_project_or_the_clone(
    builder: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, declared: str, origin: str, linked: str | None
) -> None:
    urls = f"[project.urls]\nRepository = {json.dumps(declared)}\n" if declared else ""
    (tmp_path / "pyproject.toml").write_text(f'[project]\nversion = "1.2"\n{urls}', encoding="utf-8")
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git/config").write_text(f'[core]\nrepositoryformatversion = 0\n[remote "origin"]\nurl = {origin}\n')
    (tmp_path / ".git/HEAD").write_text("ref: refs/heads/main\n")
    for folder in ("objects", "refs"):
        (tmp_path / ".git" / folder).mkdir()
    monkeypatch.setattr(builder, "ROOT", tmp_path)
    assert tomllib.loads(builder._about()).get("repo_url") == linked


def test_site_shows_a_drawing_in_its_own_scheme(
    builder: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = builder._for_site(ROOT / "docs/explanation/arbitration.md")
    assert "control-transfer.svg#only-light" in shown
    assert "control-transfer-dark.svg#only-dark" in shown
    drawing = tmp_path / "one.svg"
    drawing.write_bytes((ROOT / "docs/pictures/control-transfer.svg").read_bytes())
    builder._two_drawings(drawing)
    light, dark = drawing.read_text(encoding="utf-8"), (tmp_path / "one-dark.svg").read_text(encoding="utf-8")
    assert 'fill="#ffffff"' in light
    assert 'fill="#ffffff"' not in dark
    assert "prefers-color-scheme" not in light + dark


@pytest.mark.parametrize(("words", "found"), [("adhesion map", True), ("Map", True), ("adhesion film", False)])
def test_search_wants_all_words_in_one_section(builder: ModuleType, words: str, found: bool) -> None:
    index = [
        {"title": "Draw the map", "text": "the lowest force", "path": ["After the night", "Map adhesion"]},
        {"title": "Film", "text": "frames", "path": []},
    ]
    assert builder._finds(index, words) is found
