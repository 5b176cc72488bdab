"""Compares the marks of drivers with their claims about makers' programs: `python tools/claims.py [FOLDER …]`.

`claims.toml` in a driver's folder says what driver and emulator believe of the maker's program, and who has seen it.
In code and README, (! ID) marks a place that depends on a claim. A mark without a claim is a fault, and so is a bare
mark. Without a FOLDER, all drivers of afspm's own controllers are compared. It also makes the table of all claims for
tools/docs.py.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import quality

from afspm.basics.errors import FileError
from afspm.testing.commissioning import maker_claims
from afspm.testing.commissioning.maker_claims import GRADES, MakerClaim
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.commissioning.steps import OBSERVATIONS, all_steps

MARKED: Final = {".py", ".toml", ".md", ".lua", ".ipf", ".txt"}
_MARK: Final = re.compile(r"\(!([^)]*)\)")
_EXPLAINED: Final = "ID"
"""The id in texts that explain the mark."""

_RESTS_ON = {"seen": ("seen",), "documented": ("document", "file"), "believed": ("reported", "none")}
"""Grades by the word of the table of counts."""


def faults(folder: Path) -> Iterator[str]:
    """Yield what is wrong with the claims and marks of a driver, each with its place and remedy."""
    try:
        claims = maker_claims.read(folder)
    except FileError as error:
        yield str(error)
        return
    if not claims:
        yield f"{folder / maker_claims.FILE}: is missing; copy the one of another driver, and write its claims"
    settled_by = {step.name for step in all_steps()} | set(OBSERVATIONS)
    for name, one in claims.items():
        is_look = one.step == maker_claims.LOOKS and one.commission != one.step and bool(one.ask)
        if one.commission and one.commission not in settled_by and not is_look:
            known = ", ".join(sorted(settled_by))
            yield f"{folder / maker_claims.FILE}: {name}: no step is called {one.commission!r}; one of {known}"
    for file in sorted(one for one in folder.rglob("*") if one.suffix in MARKED and one.name != maker_claims.FILE):
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            for mark in _MARK.finditer(line):
                yield from (f"{file}:{number}: {fault}" for fault in _faults_of_mark(mark[1], claims))


def _faults_of_mark(within: str, claims: dict[str, MakerClaim]) -> Iterator[str]:
    ids = [one.strip() for one in within.split(",") if one.strip()]
    if not ids:
        yield f"(!) names no claim; write (! ID), with a row in {maker_claims.FILE}"
    for one in ids:
        if one not in claims and one != _EXPLAINED:
            yield f"(! {one}) has no row in {maker_claims.FILE}"


def counts() -> str:
    """Return how many claims each maker has by what they rest on, in Markdown."""
    heads = ["claims", *_RESTS_ON, "settled by `afspm commission`", "seen or settled so"]
    total: Counter[str] = Counter()
    lines = [f"| maker | {' | '.join(heads)} |", "| --- " * (len(heads) + 1) + "|"]
    for driver, folder in quality.drivers().items():
        of: Counter[str] = Counter()
        for one in maker_claims.read(folder).values():
            (rests_on,) = (word for word, grades in _RESTS_ON.items() if one.grade in grades)
            is_settled = bool(one.commission)
            of.update(["claims", rests_on, *[heads[4]] * is_settled, *[heads[5]] * (is_settled or rests_on == "seen")])
        total += of
        lines.append(f"| `{driver}` | {' | '.join(str(of[head]) for head in heads)} |")
    lines.append(f"| all | {' | '.join(str(total[head]) for head in heads)} |")
    meanings = [
        f"- **{word}**: " + "; ".join(f"{GRADES[grade]} (*{grade}*)" for grade in grades) + "."
        for word, grades in _RESTS_ON.items()
    ]
    return "\n".join([*lines, "", *meanings]) + "\n"


def table() -> str:
    """Return the claims of all drivers, in Markdown."""
    lines = []
    at_sample = {"contact", *(step.name for step in all_steps() if step.contact)}
    for driver, folder in quality.drivers().items():
        reports = [InstrumentReport.read(file) for file in sorted(folder.glob("reports/*.toml"))]
        lines += [
            "",
            f"## {driver}",
            "",
            "| id | claim | grade | source | what settles it | commission |",
            "| --- " * 6 + "|",
        ]
        for name, one in maker_claims.read(folder).items():
            source = one.source + (f". **Contrary**: {one.contrary}" if one.contrary else "")
            step = (
                f"`{one.commission}`" + (", at the sample" if one.step in at_sample else "") if one.commission else ""
            )
            # an emulator shares the beliefs of its driver: its report says nothing of the maker's program
            seen = [
                f"**{report.claims[name]}** ({report.release})"
                for report in reports
                if report.tried_on != "emulator"
                and report.claims.get(name, maker_claims.NOT_SHOWN) != maker_claims.NOT_SHOWN
            ]
            lines.append(
                f"| `{name}` | {one.claim} | {one.grade} | {source} | {one.settle} | {'; '.join([step, *seen])} |"
            )
    return "\n".join(lines[1:]) + "\n"


def main(*folders: str) -> None:
    wrong = [fault for one in (map(Path, folders) if folders else quality.drivers().values()) for fault in faults(one)]
    sys.exit("\n".join(wrong) or None)


if __name__ == "__main__":
    main(*sys.argv[1:])
