"""No page makes pip take afspm from PyPI, where the name is not ours: it is installed from a clone."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
_BY_NAME = re.compile(r"pip install[^`\n#]*(?<![\w./-])afspm(?![\w.]*/)")
EXPLAINS = "docs/how-to/install.md"
"""The page that says in which environment the name may be used."""


# faults 12
def test_no_page_installs_afspm_by_its_name_alone() -> None:
    pages = [
        *ROOT.glob("*.md"),
        *(page for folder in ("docs", "packages", "experiments", "src") for page in _pages(folder)),
    ]
    found = [
        f"{page.relative_to(ROOT)}:{number}: {line.strip()}"
        for page in pages
        if page.relative_to(ROOT).as_posix() != EXPLAINS
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        if _BY_NAME.search(line)
    ]
    assert not found, "\n".join(found)


def _pages(folder: str) -> list[Path]:
    return [page for page in (ROOT / folder).rglob("*.md") if "decisions" not in page.parts]
