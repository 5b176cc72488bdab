"""One or more TOML files, merged, with the line of each key."""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from afspm.basics.toml import parse_toml
from afspm.experiment import toml_lines
from afspm.experiment.findings import Findings, SourceLocation
from afspm.experiment.toml_lines import Settings


@dataclass
class Document:
    """Merged tables, and the place where each key was last set.

    Attributes:
        homes: folders in which modules are found; the first is also the start of relative file names. Empty: the
            folders of the files. (An expanded file lies in the run folder, but names files beside the original.)
        is_whole: whether all files could be read.
        findings: errors and warnings so far.
    """

    files: tuple[Path, ...]
    data: Settings = field(default_factory=dict)
    places: dict[toml_lines.Path, SourceLocation] = field(default_factory=dict)
    homes: tuple[Path, ...] = ()
    is_whole: bool = True
    findings: Findings = field(default_factory=Findings)

    def error(self, what: str, *path: str | int, hint: str = "") -> None:
        self.findings.error(what, self.place(*path), hint)

    def warning(self, what: str, *path: str | int, hint: str = "") -> None:
        self.findings.warning(what, self.place(*path), hint)

    def place(self, *path: str | int) -> SourceLocation:
        """Return the file and line that set `path`, or the innermost table around `path`; else the first file."""
        for depth in range(len(path), 0, -1):
            if (place := self.places.get(path[:depth])) is not None:
                return place
        return SourceLocation(str(self.files[0]))

    def folder_of(self, *path: str | int) -> Path:
        """Return the start of relative file names: `homes[0]`, else the folder of the file that sets `path`."""
        return self.homes[0] if self.homes else Path(self.place(*path).file).resolve().parent

    @property
    def folders(self) -> list[Path]:
        """Folders in which modules are found: `homes`, else the folders of the files, in order."""
        return list(self.homes or dict.fromkeys(file.resolve().parent for file in self.files))


REPLACES = "replaces"
"""A key of any table of a further file."""


def read(files: Sequence[Path], homes: Sequence[Path] = ()) -> Document:
    """Read the files and merge them in order: tables key by key; for any other value the last file wins.

    A table with `replaces = true` is not merged: it stands in place of the one before.

    A file that can't be read or parsed is reported in the findings, and left out.
    """
    document = Document(tuple(files), homes=tuple(homes))
    for file in files:
        text = _text(file, document.findings)
        data = None if text is None else _parse(text, file, document.findings)
        if text is None or data is None:
            document.is_whole = False
            continue
        where = {path: SourceLocation(str(file), line) for path, line in toml_lines.locate(text).items()}
        _lay_over(document, data, where)
    return document


def _text(file: Path, findings: Findings) -> str | None:
    try:
        return file.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        what = f"the file is not UTF-8 text: {error.reason} at byte {error.start}"
        findings.error(what, SourceLocation(str(file), line), 'save it as "UTF-8" in your editor')
    except OSError as error:
        if file.is_dir():
            hint = "name the experiment file in it; `afspm run --resume` goes on with a run"
            findings.error("this is a folder, not an experiment file", SourceLocation(str(file)), hint)
        else:
            findings.error(f"the file can't be read: {error.strerror or error}", SourceLocation(str(file)))
    return None


def _parse(text: str, file: Path, findings: Findings) -> Settings | None:
    try:
        return parse_toml(text)
    except tomllib.TOMLDecodeError as error:
        match = re.search(r"^(.*?) \(at (?:line (\d+), column (\d+)|end of document)\)$", str(error), re.S)
        line = text.count("\n") + 1
        what = str(error)
        if match:
            what = match[1]
            if match[2]:
                line = int(match[2])
                what += f" at column {match[3]}"
        twice = re.fullmatch(r"Cannot declare \((.*?),?\) twice", what.split(" at column")[0])
        if twice:
            name = twice[1].replace("'", "").replace(", ", ".")
            findings.error(f"[{name}] is there twice", SourceLocation(str(file), line), "two components need two names")
        else:
            written = dict(enumerate(text.splitlines(), 1)).get(line, "")
            findings.error(f"not valid TOML: {what}", SourceLocation(str(file), line), _syntax_hint(what, written))
        return None


# the parser's complaint, the form of the line, and the remedy: habits from Python, YAML, JSON and Windows
_SYNTAX_HINTS = (
    ("Cannot overwrite", r"", "this key is there already"),
    ("Illegal character '\\n'", r"", "the quote that ends the text is missing"),
    ("", r"=\s*(True|False)\b", "true and false are written in lower case"),
    ("", r"=\s*None\b", "there is no None: leave the line out"),
    ("", r"=\s*[-+]?\d+,\d", "a number has a decimal point, not a comma"),
    ("", "[\u201c\u201d\u201e\u2018\u2019]", "quotes are straight: \" or '"),
    ("", r"=\s*[^\W\d]", "text is written in quotes"),
    ("", r'"[^"]*\\', "in double quotes a backslash begins a code: take single quotes, 'C:\\data', or C:/data"),
    ("", r"=\s*\{[^}]*$", "a table in braces stays on one line; else it is one of its own, e.g. [limits.region]"),
    ("", r"^\s*\w+\s*:", "a key has its value after =; a table begins with its name in brackets: [series]"),
    ("", r"^\s*\[+\w+\s+\w", 'a name with a space is written in quotes: ["my series"]'),
)


def _syntax_hint(what: str, written: str) -> str:
    return next(
        (hint for beginning, line, hint in _SYNTAX_HINTS if what.startswith(beginning) and re.search(line, written)), ""
    )


def _lay_over(document: Document, data: Settings, where: dict[toml_lines.Path, SourceLocation]) -> None:
    _merge(document.data, data, (), document.places)
    document.places.update(where)


def _merge(
    below: Settings, above: Settings, path: toml_lines.Path, places: dict[toml_lines.Path, SourceLocation]
) -> None:
    for key, value in above.items():
        here = (*path, key)
        if path and key == REPLACES and value is True:
            continue
        is_table = isinstance(value, dict)
        if not is_table or value.get(REPLACES) is True or not isinstance(below.get(key), dict):
            for old in [p for p in places if p[: len(here)] == here]:
                del places[old]  # the value there is replaced as a whole
            below[key] = {} if is_table else copy.deepcopy(value)
        if is_table:
            _merge(below[key], value, here, places)
