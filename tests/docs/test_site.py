"""What `make docs` adds to the pages: navigation, version, repository, drawings for a light and a dark scheme."""

from __future__ import annotations

import importlib
import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
HOW_TO = ["How to: measure", "How to: watch", "How to: after the night", "How to: extend"]


@pytest.fixture(scope="module")
def builder() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "tools"))
        yield importlib.import_module("build_docs")


@pytest.fixture(scope="module")
def prepared(builder: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    builder.prepare(ROOT, folder / "pages", folder / "zensical.toml")
    return folder


def settings(config: Path) -> dict[str, Any]:
    return tomllib.loads(config.read_text(encoding="utf-8"))["project"]  # type: ignore[no-any-return]


def test_how_to_pages_stand_in_four_groups(prepared: Path) -> None:
    sections = settings(prepared / "zensical.toml")["nav"][1:]
    groups = {title: pages for section in sections for title, pages in section.items()}
    assert list(groups) == ["Tutorials", *HOW_TO, "Reference", "Explanation"]
    shown = [page for title in HOW_TO for page in groups[title] if not page.startswith("packages/")]
    pages = [f"docs/how-to/{page.name}" for page in (ROOT / "docs/how-to").glob("*.md")]
    assert sorted(shown) == sorted(["CONTRIBUTING.md", *pages])


def test_every_page_shows_the_version(prepared: Path) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    about = settings(prepared / "zensical.toml")
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
    builder: ModuleType, tmp_path: Path, declared: str, origin: str, linked: str | None
) -> None:
    urls = f"[project.urls]\nRepository = {json.dumps(declared)}\n" if declared else ""
    (tmp_path / "pyproject.toml").write_text(f'[project]\nversion = "1.2"\n{urls}', encoding="utf-8")
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git/config").write_text(f'[core]\nrepositoryformatversion = 0\n[remote "origin"]\nurl = {origin}\n')
    (tmp_path / ".git/HEAD").write_text("ref: refs/heads/main\n")
    for folder in ("objects", "refs"):
        (tmp_path / ".git" / folder).mkdir()
    (tmp_path / "docs/pictures").mkdir(parents=True)
    (tmp_path / "docs/README.md").write_text("- **Start**: [first](first.md)\n", encoding="utf-8")
    (tmp_path / "zensical.toml").write_text("[project]\n", encoding="utf-8")
    builder.prepare(tmp_path, tmp_path / "pages", tmp_path / "build.toml")
    assert settings(tmp_path / "build.toml").get("repo_url") == linked


def test_site_shows_a_drawing_in_its_own_scheme(prepared: Path) -> None:
    shown = (prepared / "pages/docs/explanation/arbitration.md").read_text(encoding="utf-8")
    assert "control-transfer.svg#only-light" in shown
    assert "control-transfer-dark.svg#only-dark" in shown
    pictures = prepared / "pages/docs/pictures"
    light = (pictures / "control-transfer.svg").read_text(encoding="utf-8")
    dark = (pictures / "control-transfer-dark.svg").read_text(encoding="utf-8")
    assert 'fill="#ffffff"' in light
    assert 'fill="#ffffff"' not in dark
    assert "prefers-color-scheme" not in light + dark


def test_search_wants_all_words_in_one_section(builder: ModuleType) -> None:
    index = [
        {"title": "Draw the map", "text": "the lowest force", "path": ["After the night", "Map adhesion"]},
        {"title": "Film", "text": "frames", "path": []},
    ]
    assert builder.unfound(index, ["adhesion map", "Map", "adhesion film"]) == ["adhesion film"]
