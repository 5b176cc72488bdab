"""Every snippet of the README and the docs runs.

On each page, in the order of the page and in one empty folder:

- ```python, ```toml and ```proto blocks whose first line is a comment with a file name (`# sharpness.py`,
  `// peaks.proto`) become that file;
- other ```python blocks are executed, sharing their names;
- other ```toml blocks must be TOML;
- ```console blocks: each line after `$ ` is run by the shell and must succeed; the lines below must come in its output,
  in this order, where … stands for anything. Lines of different processes (`… tiles … tile 1`) may come in any order.
  An error that
  the page does not show fails the test.

Blocks of other kinds (```text, ```sh …) are only shown.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.client import connect
from afspm_bench import sealing

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "experiments").rglob("*.md"))]
PAGES += [page for name in ("agents", "lab") for page in (ROOT / "packages" / f"afspm-{name}" / "docs").glob("*.md")]
OF_PACKAGES = sorted((ROOT / "packages").glob("*/README.md")) + sorted(
    (ROOT / "packages").glob("afspm-published/docs/*.md")
)
"""Pages whose snippets run in the tests of their package."""
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#]+)")
PROCESS = re.compile(r"… (\w+) …")
TROUBLE = ("ERROR", "Traceback", "Logging error")
"""Words that may only appear in the output of a snippet if the page shows them."""
FILE_NAME = re.compile(r"(?:#|//) ([\w./-]+\.(?:py|toml|proto))\n")


@dataclass
class Snippet:
    kind: str
    text: str
    line: int


def snippets(page: Path) -> list[Snippet]:
    text = page.read_text(encoding="utf-8")
    return [Snippet(m[1], m[2], text[: m.start()].count("\n") + 2) for m in BLOCK.finditer(text)]


@pytest.mark.timeout(4 * DEADLINE_S)  # a page has up to twenty commands; each has a deadline of its own
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_snippet_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connect, "JOINED_WITHIN_S", DEADLINE_S)  # of a run that a busy computer is still starting
    if page.name == "bench-an-agent.md" and (why := sealing.unavailable()):
        pytest.skip(f"its agent runs sealed, and this computer can't seal a process: {why}")
    run_page(page, tmp_path)


def run_page(page: Path, folder: Path) -> None:
    """Run the snippets of a page in an empty folder."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for snippet in snippets(page):
        where = f"{page.relative_to(ROOT)}:{snippet.line}"
        file_name = FILE_NAME.match(snippet.text)
        if file_name and snippet.kind in ("python", "toml", "proto"):
            (folder / file_name[1]).parent.mkdir(parents=True, exist_ok=True)
            (folder / file_name[1]).write_text(snippet.text, encoding="utf-8")
        elif snippet.kind == "python":
            exec(compile("\n" * (snippet.line - 1) + snippet.text, str(page), "exec"), names)
        elif snippet.kind == "toml":
            tomllib.loads(snippet.text)
        elif snippet.kind == "console":
            run_console(snippet.text, folder, where)


def run_console(text: str, folder: Path, where: str) -> None:
    bin_folder = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}", "COLUMNS": "120"}
    for part in re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]:
        command, _, expected = part.partition("\n")
        if not (folder / "experiments").exists() and "experiments/" in command:
            shutil.copytree(ROOT / "experiments", folder / "experiments")
        done = subprocess.run(
            command,
            shell=True,
            cwd=folder,
            env=environment,
            capture_output=True,
            encoding="utf-8",
            timeout=DEADLINE_S,
            check=False,
        )
        output = done.stdout + done.stderr
        assert done.returncode == 0, f"{where}: {command} failed:\n{output}"
        for word in TROUBLE:
            assert word in expected or word not in output, f"{where}: {word} in the output of {command}:\n{output}"
        ends: defaultdict[str, int] = defaultdict(int)
        for line in filter(None, map(str.strip, expected.splitlines())):
            pattern = ".*?".join(re.escape(piece) for piece in line.split("…"))
            process = named[1] if (named := PROCESS.match(line)) else ""
            found = re.compile(pattern).search(output, ends[process])
            assert found, f"{where}: {line!r} does not come in the output of {command}:\n{output}"
            ends[process] = found.end()


def test_pages_are_found() -> None:
    assert len(PAGES) > 5


@pytest.mark.parametrize("page", [*PAGES, *OF_PACKAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_link_within_the_project_has_a_target(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), f"{page.relative_to(ROOT)} links to {target}, which does not exist"


@pytest.mark.parametrize(
    ("listing", "pages"),
    [
        ("docs/README.md", "docs/*/*.md"),
        ("docs/explanation/decisions/README.md", "docs/explanation/decisions/*.md"),
        ("experiments/README.md", "experiments/*/README.md"),
    ],
)
def test_every_page_is_listed(listing: str, pages: str) -> None:
    page = ROOT / listing
    linked = {(page.parent / target).resolve() for target in LINK.findall(page.read_text(encoding="utf-8"))}
    found = {file for file in ROOT.glob(pages) if file != page}
    assert found
    assert found <= linked


def test_decision_numbers_are_unique_and_in_titles() -> None:
    pages = [page for page in sorted((ROOT / "docs/explanation/decisions").glob("*.md")) if page.name != "README.md"]
    numbers = [page.name[:5] for page in pages]
    assert len(set(numbers)) == len(numbers)
    for page in pages:
        assert re.match(r"\d{4}-", page.name)
        assert page.read_text(encoding="utf-8").startswith(f"# {page.name[:4]} ")
