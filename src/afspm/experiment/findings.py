"""Findings of a check, each with file, line and remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum


class Level(Enum):
    """The severity of a finding: an error keeps the experiment from starting; a note is of `afspm check` alone."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class SourceLocation:
    """A line of a file; line 0 means the file as a whole."""

    file: str
    line: int = 0

    def __str__(self) -> str:
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass(frozen=True)
class Finding:
    """One error, warning or note about an experiment file."""

    level: Level
    what: str
    place: SourceLocation
    hint: str = ""

    def __post_init__(self) -> None:
        # security: a file from elsewhere may name a table by commands to the terminal
        object.__setattr__(self, "what", _visible(self.what))
        object.__setattr__(self, "hint", _visible(self.hint))

    @property
    def is_error(self) -> bool:
        return self.level is Level.ERROR

    def __str__(self) -> str:
        hint = f" ({self.hint})" if self.hint else ""
        return f"{self.place}: {self.level.value}: {self.what}{hint}"


@dataclass
class Findings:
    """A collection of the findings of one check."""

    found: list[Finding] = field(default_factory=list)

    def error(self, what: str, place: SourceLocation, hint: str = "") -> None:
        self._add(Finding(Level.ERROR, what, place, hint))

    def warning(self, what: str, place: SourceLocation, hint: str = "") -> None:
        self._add(Finding(Level.WARNING, what, place, hint))

    def _add(self, finding: Finding) -> None:
        if finding not in self.found:
            self.found.append(finding)

    @property
    def errors(self) -> int:
        return sum(finding.is_error for finding in self.found)

    def ordered(self) -> list[Finding]:
        """Return the findings: errors first, then by file and line."""
        return sorted(self.found, key=lambda f: (not f.is_error, f.place.file, f.place.line))


_PARTS = re.compile(r"[-_.\s]+")
_SURE = 0.75
_MOST_NAMES = 12


def nearest(name: str, valid: Iterable[str], cutoff: float = 0.6) -> str:
    """Return a hint with the valid name nearest to `name`, or up to 12 valid names; empty without any.

    The nearest name is spelled alike, or else the only one with all parts of `name`: "bias" is of "tip-bias-voltage".
    Of more than 12 names, those most alike are given.
    """
    names = sorted(set(valid))
    close = closest(name, names, cutoff)
    parts = _parts(name)
    having = [one for one in names if parts and parts <= _parts(one)]
    if close is None and len(having) == 1:
        close = having[0]
    if close:
        return f"did you mean {close!r}?"
    if not names:
        return ""
    by_likeness = sorted(names, key=lambda one: (one not in having, -_likeness(name, one)))
    shown = ", ".join(sorted(by_likeness[:_MOST_NAMES])) + (", …" if len(names) > _MOST_NAMES else "")
    return f"known here: {shown}"


def closest(name: str, valid: Iterable[str], cutoff: float = 0.6) -> str | None:
    """Return the valid name nearest to `name`, ignoring case; None if none is near.

    A name with another first letter must be nearer: "surface" is no misspelled "trace".
    """
    by_fold = {v.casefold(): v for v in valid}
    for match in difflib.get_close_matches(name.casefold(), list(by_fold), n=3, cutoff=cutoff):
        if match[:1] == name.casefold()[:1] or _likeness(name, match) >= _SURE:
            return by_fold[match]
    return None


def _visible(text: str) -> str:
    return "".join(
        one if one.isprintable() or one in "\n\xa0\u202f" else one.encode("unicode_escape").decode() for one in text
    )


def _parts(name: str) -> set[str]:
    return set(filter(None, _PARTS.split(name.casefold())))


def _likeness(name: str, other: str) -> float:
    return difflib.SequenceMatcher(None, other.casefold(), name.casefold()).ratio()
