"""Each picture of the documentation is shown by a page."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PICTURES = ROOT / "docs" / "pictures"
SHOWN = re.compile(r'(?:!\[[^\]]*\]\(|<img src=")[^)"]*pictures/([^)"]+)')


def test_each_picture_is_shown_by_a_page() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    shown = {name for page in pages for name in SHOWN.findall(page.read_text(encoding="utf-8"))}
    assert shown == {file.name for file in PICTURES.iterdir() if file.suffix != ".json"}
