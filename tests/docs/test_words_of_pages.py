"""Pages are free of the words that our style rules out: persons for processes, verbs of speech, clauses for nouns.

Code, quoted names and messages, parts made from the code, and decisions of earlier days are left out. A line that needs
such a word ends with `<!-- word: told -->`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
WORDS = (
    *("anew", "whoever", "whatever", "whosoever", "told", "tells", "said", "heard", "nobody", "somebody", "of which"),
    *("by which", "what is", "what has", "is to be", "those that", "that of", "so many"),
)
FOUND = re.compile(r"\b(" + "|".join(words.replace(" ", r"\s+") for words in WORDS) + r")\b", re.IGNORECASE)
LEFT_OUT = re.compile(
    r"<!-- from the code.*?<!-- end -->|^ *```.*?^ *```$|^    \S[^\n]*$|`[^`\n]+`|\]\([^)\n]+\)"
    r"|^\| `\w+/[\w-]+` \|[^\n]*$",
    re.MULTILINE | re.DOTALL,
)
MARKER = re.compile(r"<!-- word: ([\w ]+) -->")
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "changes/README.md")),
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if not re.match(r"\d{4}-", page.name)),
    *sorted((ROOT / "experiments").rglob("*.md")),
]


def findings(text: str) -> Iterator[tuple[int, str]]:
    """Yield (line, word) of each word that a page should not have."""
    blanked = LEFT_OUT.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)
    lines = text.splitlines()
    for found in FOUND.finditer(blanked):
        number, word = blanked[: found.start()].count("\n") + 1, " ".join(found[1].lower().split())
        if word not in MARKER.findall(lines[number - 1]):
            yield number, word


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_page_has_none_of_the_words(page: Path) -> None:
    assert list(findings(page.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("A page.\nThe translator is told so.", [(2, "told")]),
        ("The part of\nwhich the end is seen.", [(1, "of which")]),
        ("The log says `nobody is in control`.", []),
        ("```text\nit is told\n```\n", []),
        ("    afspm run\n\nIt was told", [(3, "told")]),
        ("It was told <!-- word: told -->", []),
        ("It was told <!-- word: said -->", [(1, "told")]),
        ("Untold retold, that offer", []),
    ],
)
def test_words_are_found_in_prose_alone(text: str, expected: list[tuple[int, str]]) -> None:
    assert list(findings(text)) == expected
