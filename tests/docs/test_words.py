"""Words that make a sentence hard to read are in no docstring, comment, message, page or name of a test.

They stand for a missing noun ("whoever hosts it", "those that came") or make data speak ("told", "said"). A line that
needs one ends with `# word: told` (in a page: `<!-- word: told -->`).
"""

from __future__ import annotations

import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = (
    "packages/afspm-agents/src",
    "packages/afspm-bench/src",
    "packages/afspm-lab/src",
    "packages/afspm-nion/src",
    "packages/afspm-published/src",
)
WORDS = (
    "anew",
    "whoever",
    "whatever",
    "whosoever",
    "told",
    "tells",
    "said",
    "heard",
    "nobody",
    "somebody",
    "of which",
    "by which",
    "what is",
    "what has",
    "is to be",
    "those that",
    "that of",
    "so many",
)
FOUND = re.compile(rf"\b({'|'.join(WORDS)})\b", re.IGNORECASE)
IN_A_NAME = re.compile(rf"(?<=_)({'|'.join(word.replace(' ', '_') for word in WORDS)})(?=_|$)")
TEST = re.compile(r" *(?:async )?def (test_\w+)\(")
EXPRESSION = re.compile(r"\{[^{}]*\}")  # of an f-string
MARKER = re.compile(r"(?:#|<!--) word: ([\w, ]+)")
REMEDY = (
    '\nWrite the noun, or a verb that fits data: the table under "How we write" in CONTRIBUTING.md has examples. '
    "A line that needs the word ends with `# word: ` and the word, a line of a page with `<!-- word: ` and the word."
)
# code blocks, code in a line, and the addresses of links
NOT_PROSE = re.compile(r"^(```|~~~).*?^\1|`[^`\n]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)


def _python(folder: str) -> list[Path]:
    return [file for file in sorted((ROOT / folder).rglob("*.py")) if "generated" not in file.parts]


def _pages() -> list[Path]:
    decisions = ROOT / "docs" / "explanation" / "decisions"
    pages = [file for file in sorted((ROOT / "docs").rglob("*.md")) if decisions not in file.parents]
    samples = sorted((ROOT / "experiments").rglob("*.md"))
    packages = sorted(ROOT.glob("packages/*/README.md")) + sorted(ROOT.glob("packages/*/docs/*.md"))
    return [*pages, *sorted(ROOT.glob("*.md")), *sorted((ROOT / "src").rglob("*.md")), *samples, *packages]


def _sentences(source: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of docstrings, messages and comments with their numbers; a string without a space is a name."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        is_text = token.type == tokenize.STRING or tokenize.tok_name[token.type] == "FSTRING_MIDDLE"
        if token.type == tokenize.COMMENT or (is_text and " " in token.string):
            for offset, line in enumerate(EXPRESSION.sub("", token.string).splitlines()):
                yield token.start[0] + offset, line


def _unmarked(line: str, pattern: re.Pattern[str], whole_line: str) -> list[str]:
    allowed = {word for found in MARKER.findall(whole_line) for word in found.strip().lower().split(", ")}
    return [word for word in pattern.findall(line) if word.lower().replace("_", " ") not in allowed]


def _report(file: Path, number: int, words: list[str], line: str) -> list[str]:
    place = f"{file.relative_to(ROOT).as_posix()}:{number}"
    return [f"{place}: avoid {', '.join(map(repr, words))} in: {line.strip()}"] if words else []


def in_source(file: Path) -> list[str]:
    source = file.read_text(encoding="utf-8")
    lines = source.splitlines()
    found: list[str] = []
    if not FOUND.search(source):  # parsing takes long
        return found
    for number, text in _sentences(source):
        found += _report(file, number, _unmarked(MARKER.sub("", text), FOUND, lines[number - 1]), lines[number - 1])
    return found


def in_page(file: Path) -> list[str]:
    page = file.read_text(encoding="utf-8")
    prose = NOT_PROSE.sub(lambda match: "\n" * match[0].count("\n"), page)
    found = []
    for number, line in enumerate(prose.splitlines(), 1):
        found += _report(file, number, _unmarked(MARKER.sub("", line), FOUND, line), line)
    return found


def in_test_names(file: Path) -> list[str]:
    source = file.read_text(encoding="utf-8")
    found = []
    for number, line in enumerate(source.splitlines(), 1):
        if name := TEST.match(line):
            found += _report(file, number, _unmarked(name[1], IN_A_NAME, line), line)
    return found


def test_source_is_free_of_the_words() -> None:
    found = [line for folder in ("src", *PACKAGES) for file in _python(folder) for line in in_source(file)]
    assert not found, "\n".join(found) + REMEDY


def test_pages_are_free_of_the_words() -> None:
    found = [line for file in _pages() for line in in_page(file)]
    assert not found, "\n".join(found) + REMEDY


def test_names_of_tests_are_free_of_the_words() -> None:
    folders = ["tests", *(folder.relative_to(ROOT).as_posix() for folder in sorted(ROOT.glob("packages/*/tests")))]
    found = [line for folder in folders for file in _python(folder) for line in in_test_names(file)]
    assert not found, "\n".join(found) + REMEDY


def test_words_are_found_in_each_kind_of_text() -> None:
    docstring, comment, message = '"""Return what is told."""', "# nobody", 'return f"{x} was said"  # word: said'
    source = f"def f(x: int) -> str:\n    {docstring}\n    {comment}\n    {message}\n"
    assert [word for _, line in _sentences(source) for word in FOUND.findall(line)] == [
        "what is",
        "told",
        "nobody",
        "said",
        "said",
    ]
    assert _unmarked("was said", FOUND, 'f"{x} was said"  # word: said') == []
    assert _unmarked("test_who_was_told_that", IN_A_NAME, "") == ["told"]
    assert NOT_PROSE.sub("", "the `told` field\n```\nsaid\n```\nend") == "the  field\n\nend"
