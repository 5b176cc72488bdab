"""The experience of the nights: in a memory during a night, in a TOML file that a person can read, edit or delete."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.basics.toml import parse_toml
from afspm.components.tip_experience import (
    CURED,
    OUTCOMES,
    UNCHANGED,
    UNKNOWN_FLAW,
    WORSENED,
    OutcomeCounts,
    TipExperience,
)
from afspm.components.tip_treatments import Treatment
from afspm.model.snapshot import from_plain, to_plain
from afspm.storage.atomic import write_atomic
from afspm.storage.memory import Memory

_HEAD = """\
# What a TipCorrector has learnt: how often each treatment cured a tip with each flaw, worsened it, or did nothing.
# Older outcomes count less than one. You may edit or delete this file while no experiment runs.
"""


class NightsExperience:
    """The experience of this night, from the file of past nights, in the memory of a component and in the file again.

    Args:
        allowed: all treatments of the experiment; their order must not change in a run.
    """

    def __init__(self, path: Path, allowed: Sequence[Treatment], memory: Memory, log: logging.Logger) -> None:
        self._path: Path | None = path
        self._allowed, self._memory, self._log = allowed, memory, log
        try:
            before = read_experience(path)
        except FileError as error:  # a night without experience is better than none
            log.error("%s; this night begins without experience, and leaves the file as it is", error)
            self._path, before = None, TipExperience()
        if "experience" in memory:
            self._experience: TipExperience = from_plain(TipExperience, memory["experience"])
            return
        self._experience = before.for_next_night()
        memory["experience"] = to_plain(self._experience)
        memory.save()

    def choose(self, flaw: str, affordable: Sequence[Treatment]) -> Treatment:
        """Return the treatment to try next on a flaw."""
        return self._experience.choose(flaw, affordable)

    def begin(self, flaw: str, treatment: Treatment) -> None:
        """Note a treatment about to be attempted; the caller saves the memory."""
        self._memory["pending"] = [flaw, self._allowed.index(treatment)]

    def end(self, flaw: str, *, cured: bool) -> None:
        """Count the outcome of the pending treatment, if any, from the flaw after it."""
        if "pending" not in self._memory:
            return
        before, number = self._memory.pop("pending")
        outcome = CURED if cured else UNCHANGED if flaw in (before, UNKNOWN_FLAW) else WORSENED
        if self._experience.learn(before, self._allowed[number], outcome):
            self._log.info("the %s tip answers otherwise than before: its experience counts less from now on", before)
        self._memory["experience"] = to_plain(self._experience)
        self._memory.save()
        if self._path is None:
            return
        try:
            write_experience(self._path, self._experience)
        except FileError as error:  # the memory has it, and the next outcome writes it again
            self._log.warning("what was learnt is not in its file: %s", error)


def experience_text(experience: TipExperience) -> str:
    """Return the text of an experience file."""
    lines = [_HEAD, f"nights = {experience.nights}"]
    for flaw, treatments in sorted(experience.counts.items()):
        lines += ["", f'["{flaw}"]']
        for name, counts in sorted(treatments.items()):
            values = ", ".join(f"{outcome} = {getattr(counts, outcome):.4g}" for outcome in OUTCOMES)
            lines.append(f'"{name}" = {{ {values} }}')
    return "\n".join(lines) + "\n"


def write_experience(path: Path, experience: TipExperience) -> None:
    """Write an experience file, and make its folder. Raises FileError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"can't be created: {error}", where=str(path.parent)) from error
    write_atomic(path, [experience_text(experience).encode()])


def read_experience(path: Path) -> TipExperience:
    """Return the experience in a file; empty if there is no file.

    Raises:
        FileError: the file can't be read, or has other content.
    """
    try:
        content = parse_toml(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return TipExperience()
    except (OSError, ValueError) as error:
        raise FileError(f"can't be read: {error}", where=str(path), hint="mend or delete it") from error
    nights = content.pop("nights", 0)
    if isinstance(nights, bool) or not isinstance(nights, int) or nights < 0:
        raise FileError(f"`nights` must be a whole number, not {nights!r}", where=str(path))
    found = TipExperience(nights)
    for flaw, treatments in content.items():
        if not isinstance(treatments, dict):
            raise FileError(f"{flaw!r} must be a table of treatments", where=str(path), hint="mend or delete it")
        found.counts[flaw] = {name: _counts(values, path, f"{flaw}: {name}") for name, values in treatments.items()}
    return found


def _counts(values: object, path: Path, where: str) -> OutcomeCounts:
    wrong = FileError(
        f"{where}: expected a table of numbers from 0 on, {', '.join(OUTCOMES)}, and got {values!r}",
        where=str(path),
        hint="mend or delete it",
    )
    if not isinstance(values, dict) or not set(values) <= set(OUTCOMES):
        raise wrong
    for value in values.values():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
            raise wrong
    return OutcomeCounts(**{name: float(value) for name, value in values.items()})
