"""The tests of the page run again after a change of the page or of what it shows, and after no other."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
FILES = {
    "uv.lock": 'name = "nicegui"\nversion = "3.0"\n',
    "src/lab/__init__.py": "",
    "src/afspm/__init__.py": "",
    "src/afspm/basics.py": "",
    "src/afspm/record/__init__.py": "if TYPE_CHECKING:\n    from afspm.record.chart import Axis as A\n",
    "src/afspm/record/chart.py": "class Axis: pass\n",
    "src/afspm/record/journal.py": "",
    "src/afspm/plugins/web/page.py": "from afspm.basics import si\nfrom afspm.record import A\n",
    "src/afspm/plugins/web/assets/page.js": "draw();\n",
    "tests/ui/test_page.py": "from small_disk import fill\n",
    "tests/support/small_disk.py": "",
}
SHOWN = {"src/afspm/record/chart.py", "tests/support/small_disk.py"}
OWN = {"src/afspm/plugins/web/page.py", "src/afspm/plugins/web/assets/page.js", "tests/ui/test_page.py"}


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("page_sources")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8", newline="\n")
    return tmp_path


def test_page_and_modules_that_it_draws_with_are_its_sources(tool: ModuleType, tree: Path) -> None:
    assert set(tool.sources(tree)) == OWN | SHOWN


@pytest.mark.parametrize("name", FILES)
def test_state_changes_with_sources_alone(tool: ModuleType, tree: Path, name: str) -> None:
    before = tool.state(tree)
    (tree / name).write_text(FILES[name].replace("3.0", "3.1") + "\n", encoding="utf-8")
    assert (tool.state(tree) != before) == (name in OWN | SHOWN | {"uv.lock"})


def test_state_depends_neither_on_line_ends_nor_on_files_left_by_a_run(tool: ModuleType, tree: Path) -> None:
    before = tool.state(tree)
    for name, text in FILES.items():
        (tree / name).write_text(text, encoding="utf-8", newline="\r\n")
    for left in ("src/afspm/plugins/web/__pycache__/page.pyc", tool.LAST_GREEN):
        (tree / left).parent.mkdir(exist_ok=True)
        (tree / left).write_text("left", encoding="utf-8")
    assert tool.state(tree) == before
