"""Claims: what a driver and its emulator believe of a maker's program, and who has seen it.

They stand in `claims.toml` beside the driver's `parameters.toml`. A step of the commissioning settles some of them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from afspm.basics.errors import FileError

FILE: Final = "claims.toml"
GRADES: Final[Mapping[str, str]] = {
    "seen": "seen by us at the maker's program",
    "document": "the maker's document, or its published code",
    "reported": "reported by others who run one",
    "file": "files of real instruments",
    "none": "no evidence",
}
LOOKS: Final = "looks"
"""The step that asks the person what only a person can see: one observation each, "looks/pixels-of-16"."""
HOLDS, FALSE, NOT_SHOWN = "holds", "does not hold", "not shown"


@dataclass(frozen=True)
class MakerClaim:
    """One claim about a maker's program.

    Attributes:
        claim: the claim, as one sentence.
        grade: one of `GRADES`: the best evidence.
        source: where it is seen, written or reported.
        settle: the observation that would settle the claim.
        contrary: the source of a contrary report; empty: none.
        commission: the step of `afspm commission` that settles the claim, "angle", or one observation of a step,
            "lines/rows"; empty: none does.
        ask: what the person prepares at the panel before that step, or what must be so for it to say anything; of a
            look, the question whose yes means that the claim holds.
    """

    claim: str
    grade: str
    source: str
    settle: str
    contrary: str = ""
    commission: str = ""
    ask: str = ""

    @property
    def step(self) -> str:
        """The name of the step that settles the claim; empty: none does."""
        return step_of(self.commission)


def step_of(observation: str) -> str:
    """Return the name of the step of an observation."""
    return observation.partition("/")[0]


def read(folder: Path) -> dict[str, MakerClaim]:
    """Return the claims of the driver in a folder, by their ids; empty without a file.

    Raises:
        FileError: a claim is incomplete, or has an unknown key or grade.
    """
    file = folder / FILE
    if not file.exists():
        return {}
    try:
        claims = {name: MakerClaim(**row) for name, row in tomllib.loads(file.read_text(encoding="utf-8")).items()}
    except (OSError, ValueError, TypeError) as error:
        raise FileError(f"can't be read: {error}", where=str(file)) from error
    for name, one in claims.items():
        if one.grade not in GRADES:
            raise FileError(f"{name}: {one.grade!r} is no grade", where=str(file), hint=f"one of {', '.join(GRADES)}")
    return claims


def verdicts(
    claims: Mapping[str, MakerClaim], step: str, seen: Mapping[str, bool], unprepared: Collection[str]
) -> dict[str, str]:
    """Return the verdicts on the claims that a step should settle, by their ids.

    Args:
        seen: the observations, by the names in `commission`: True if the claim holds.
        unprepared: the claims for which the person did not do what `ask` says.
    """
    found = {}
    for name, one in claims.items():
        if one.step == step:
            holds = None if name in unprepared else seen.get(one.commission)
            found[name] = NOT_SHOWN if holds is None else HOLDS if holds else FALSE
    return found
