"""Every snippet of the package's pages runs."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.docs.test_snippets import run_page

PAGES = sorted((Path(__file__).parents[1] / "docs").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_snippet_of_the_package_runs(page: Path, tmp_path: Path) -> None:
    run_page(page, tmp_path)
