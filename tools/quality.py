"""Compares the answers of drivers with the rules of the quality scale: `python tools/quality.py [FOLDER …]`.

The rules are in tools/quality_rules.toml. Each driver has a quality.toml in its folder, with one answer to each rule:

    scan.done = ["tests/test_my_scope.py::test_frame", "test-translator::scan/frame"]
    live-lines = "todo"
    safe-end.exempt = "the controller has no command for the feedback"

A test is named from the folder of the package's pyproject.toml; `test-translator::` names a check of
`afspm test-translator`, and `reports/` a commissioning report in the driver's folder, where the rule demands one.
Without a FOLDER, all drivers of afspm's own controllers are compared. A folder may be outside this tree.
"""

from __future__ import annotations

import ast
import difflib
import sys
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from afspm.basics import entry_points
from afspm.basics.errors import FileError
from afspm.testing.commissioning.report import InstrumentReport
from afspm.testing.translators.translator_suite import TRANSLATOR_SUITE

ROOT = Path(__file__).resolve().parents[1]
RULES = ROOT / "tools" / "quality_rules.toml"
FILE = "quality.toml"
SUITE = "test-translator"
LEVELS = {
    "bronze": "reads, scans, refuses",
    "silver": "a person at the panel, restarts, units, live lines",
    "gold": "commissioned on the emulator, the maker's own client or program, spectra, all components",
    "platinum": "tried on a real instrument, with its report",
}
HOW = '`{0}.done = ["FILE::TEST"]`, `{0} = "todo"` or `{0}.exempt = "REASON"`'


@dataclass(frozen=True)
class Rule:
    """A rule of the scale; `tried_on` lists the kinds of report that answer it, if it demands a report."""

    name: str
    level: str
    says: str
    tried_on: tuple[str, ...] = ()


@dataclass(frozen=True)
class Answer:
    """The answer of a driver to a rule: tests, or the reason of an exemption, or neither while it is to do."""

    done: tuple[str, ...] = ()
    exempt: str = ""

    @property
    def is_todo(self) -> bool:
        return not self.done and not self.exempt


@cache
def rules() -> dict[str, Rule]:
    """Return the rules by name, from bronze to platinum."""
    tables = tomllib.loads(RULES.read_text(encoding="utf-8"))
    return {
        name: Rule(name, level, facts["says"], tuple(facts.get("tried_on", ())))
        for level in LEVELS
        for name, facts in tables[level].items()
    }


def drivers() -> dict[str, Path]:
    """Return the folders of the drivers that command a controller; a simulated microscope has no scale."""
    names = entry_points.names(entry_points.DRIVERS)
    real = (name for name in names if not entry_points.load(entry_points.DRIVERS, name).simulated)
    folders = {name: entry_points.folder(entry_points.DRIVERS, name) for name in real}
    return {name: folder for name, folder in folders.items() if folder is not None and ROOT in folder.parents}


def answers(folder: Path) -> tuple[dict[str, Answer], list[str]]:
    """Return the answers of a driver, to do where there is none, and the faults of its file, each with its remedy."""
    found = dict.fromkeys(rules(), Answer())
    try:
        table = tomllib.loads((folder / FILE).read_text(encoding="utf-8"))
    except OSError:
        return found, [f"the driver has no {FILE}; copy that of another driver, and answer each rule"]
    except ValueError as error:
        return found, [f"is not TOML: {error}"]
    wrong: list[str] = []
    for name, value in table.items():
        if name not in rules():
            near = difflib.get_close_matches(name, rules(), 1)
            wrong.append(f"{name}: no such rule; {f'did you mean {near[0]}?' if near else f'see {RULES.name}'}")
        elif (answer := _answer(value)) is None:
            wrong.append(f"{name}: {value!r} is no answer; write {HOW.format(name)}")
        else:
            found[name] = answer
            wrong += [f"{name}: {fault}" for fault in _faults(rules()[name], answer, folder)]
    for name in [name for name in rules() if name not in table]:
        wrong.append(f"{name}: has no answer ({rules()[name].says}) Write {HOW.format(name)}")
    return found, wrong


def _answer(value: Any) -> Answer | None:
    match value:
        case "todo":
            return Answer()
        case {"exempt": str(reason), **rest} if reason.strip() and not rest:
            return Answer(exempt=reason)
        case {"done": [*tests], **rest} if tests and not rest and all(isinstance(one, str) for one in tests):
            return Answer(done=tuple(tests))
    return None


def _faults(rule: Rule, answer: Answer, folder: Path) -> Iterator[str]:
    if answer.exempt and rule.level == "platinum":
        yield 'no driver is exempt from platinum; write "todo" until a report of an instrument is there'
    reports = [one for one in answer.done if one.startswith("reports/")]
    for one in answer.done:
        if one not in reports:
            yield from _faults_of_test(one, folder)
    if not rule.tried_on and reports:
        yield f"{reports[0]} is a report, and this rule asks for tests; name one as FILE::TEST"
    if rule.tried_on and answer.done and not reports:
        kinds = " or ".join(repr(kind) for kind in rule.tried_on)
        yield f'names no report tried on {kinds}; add "reports/NAME.toml" in the folder of the driver'
    for one in reports if rule.tried_on else ():
        try:
            report = InstrumentReport.read(folder / one)
        except FileError as error:
            yield f"{one}: {error}; name a report of `afspm commission`"
            continue
        if report.tried_on not in rule.tried_on:
            yield f"{one} was tried on {report.tried_on!r}, not on {' or '.join(map(repr, rule.tried_on))}"
        for operation in [name for name, outcome in report.operations.items() if outcome == "mismatch"]:
            yield f'{operation} failed in {one}; write "todo" until a report passes'


def _faults_of_test(named: str, folder: Path) -> Iterator[str]:
    file, _, test = named.partition("::")
    if file == SUITE:
        if test not in {check.name for check in TRANSLATOR_SUITE.checks()}:
            yield f"{test!r} is no check of `afspm {SUITE}`; `afspm {SUITE} --list` lists them"
        return
    root = next((one for one in (folder, *folder.resolve().parents) if (one / "pyproject.toml").exists()), None)
    if root is None:
        yield f"{named} can't be found, since no folder above the driver has a pyproject.toml; add one"
    elif not (root / file).is_file():
        yield f'there is no file {file} below {root.name}; name an existing FILE::TEST, or write "todo"'
    elif test not in _tests(root / file):
        near = difflib.get_close_matches(test, _tests(root / file), 1)
        yield f"{file} has no test {test!r}; {f'did you mean {near[0]}?' if near else 'name one of its tests'}"


@cache
def _tests(file: Path) -> frozenset[str]:
    """Return the names of the tests in a file, found in its syntax tree, since importing takes seconds."""
    body = ast.parse(file.read_text(encoding="utf-8")).body
    groups = [("", body), *((f"{one.name}::", one.body) for one in body if isinstance(one, ast.ClassDef))]
    return frozenset(
        f"{before}{one.name}"
        for before, statements in groups
        for one in statements
        if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef)) and one.name.startswith("test")
    )


def answered(given: Mapping[str, Answer], level: str) -> int:
    """Return the number of rules of a level that are done or exempt."""
    return sum(rule.level == level and not given[name].is_todo for name, rule in rules().items())


def reached(given: Mapping[str, Answer]) -> list[str]:
    """Return the levels that a driver has reached: all rules of the level and of those below are done or exempt."""
    levels = list(LEVELS)
    missing = [rule.level for name, rule in rules().items() if given[name].is_todo]
    return levels[: min((levels.index(level) for level in missing), default=len(levels))]


def scale_tables() -> str:
    """Return the levels of all drivers, and for each driver its rules to do and its exemptions, in Markdown."""
    given = {name: answers(folder)[0] for name, folder in drivers().items()}
    lines = [f"| level | about | {' | '.join(given)} |", "| --- " * (len(given) + 2) + "|"]
    for level, about in LEVELS.items():
        count = sum(rule.level == level for rule in rules().values())
        cells = ["reached" if level in reached(one) else f"{answered(one, level)} of {count}" for one in given.values()]
        lines.append(f"| {level} | {about} | {' | '.join(cells)} |")
    highest = list(LEVELS)[-1]
    if not any(highest in reached(one) for one in given.values()):
        lines += ["", f"**No driver has reached {highest}.** The numbers count the rules that are done or exempt."]
    for name, one in given.items():
        todo = [f"`{rule}` ({rules()[rule].level})" for rule in rules() if one[rule].is_todo]
        exempt = [f"- `{rule}` is exempt: {one[rule].exempt}." for rule in rules() if one[rule].exempt]
        lines += ["", f"### {name}", "", f"- To do: {', '.join(todo) or 'nothing'}.", *exempt]
    return "\n".join(lines) + "\n"


def rules_table() -> str:
    """Return the rules with their levels, in Markdown."""
    rows = [f"| {rule.level} | `{name}` | {rule.says} |" for name, rule in rules().items()]
    return "\n".join(["| level | rule | passed if |", "| --- | --- | --- |", *rows]) + "\n"


def main(*folders: str) -> None:
    wrong = [
        f"{folder / FILE}: {fault}"
        for folder in (map(Path, folders) if folders else drivers().values())
        for fault in answers(folder)[1]
    ]
    sys.exit("\n".join(wrong) or None)


if __name__ == "__main__":
    main(*sys.argv[1:])
