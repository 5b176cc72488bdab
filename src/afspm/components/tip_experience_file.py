"""The experience of past nights in a TOML file that a person can read, edit or delete."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

from afspm.basics.errors import FileError
from afspm.components.tip_experience import OUTCOMES, OutcomeCounts, TipExperience
from afspm.storage.atomic import write_atomic

_HEAD = """\
# What a TipCorrector has learnt: how often each treatment cured a tip with each flaw, worsened it, or did nothing.
# Older outcomes count less than one. You may edit or delete this file while no experiment runs.
"""


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
        content = tomllib.loads(path.read_text(encoding="utf-8"))
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
