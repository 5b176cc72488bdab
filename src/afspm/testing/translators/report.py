"""The report of all checks, as text and as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from afspm.model import names
from afspm.testing.translators.support import Support
from afspm.testing.verdicts import CheckOutcome, CheckResult


@dataclass
class CheckReport:
    """All of them.

    Attributes:
        translator: its class or command.
        lost: why the checks could not be finished; empty if they were.
        unrestored: what could not be put back, a line each.
        folder: with the log and all files.
    """

    translator: str = ""
    simulated: bool = False
    afspm: str = ""
    began: str = ""
    results: list[CheckResult] = field(default_factory=list)
    support: Support = field(default_factory=Support)
    lost: str = ""
    unrestored: list[str] = field(default_factory=list)
    folder: str = ""

    @property
    def passed(self) -> bool:
        """True if nothing was wrong; what is not supported is no fault."""
        return bool(self.results) and not (self.failed or self.lost or self.unrestored or self.support.errors)

    @property
    def failed(self) -> list[CheckResult]:
        return [result for result in self.results if result.outcome is CheckOutcome.FAILED]

    def count(self, outcome: CheckOutcome) -> int:
        return sum(result.outcome is outcome for result in self.results)

    def to_json(self) -> str:
        """For programs: `passed`, the checks, and what is supported, with the controller's version."""
        facts: dict[str, object] = {
            "passed": self.passed,
            "translator": self.translator,
            "controller": self.support.controller,
            "simulated": self.simulated,
            "afspm": self.afspm,
            "began": self.began,
            "lost": self.lost,
            "unrestored": self.unrestored,
            "wrong_answers": self.support.errors,
            "checks": [{**asdict(result), "outcome": result.outcome.value} for result in self.results],
            "actions": [{"name": name, "supported": has} for name, has in self.support.actions.items()],
            "parameters": [self._parameter(name) for name in self.support.parameters],
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"

    def _parameter(self, name: str) -> dict[str, object]:
        told = self.support.parameters[name]
        return {
            "name": name,
            "supported": told is not None,
            "value": None if told is None else told.value,
            "unit": None if told is None else told.unit,
            "settable": self.support.settable.get(name),
        }


def show_beginning(report: CheckReport, console: Console) -> None:
    """Print what will be checked."""
    told = report.support.controller or "its controller does not report its version"
    simulated = " SIMULATED" if report.simulated else ""
    console.print(Text.assemble((report.translator, "bold"), f": {told}", (simulated, "bold yellow")), soft_wrap=True)


def show_end(report: CheckReport, console: Console) -> None:
    """The tables, and what came of it all."""
    console.print(_actions(report))
    console.print(_parameters(report))
    for failure in report.failed:
        console.print(Text.assemble(("✗ ", "bold red"), f"{failure.name}: {failure.line}"), soft_wrap=True)
    for what, lines in (("wrong answer", report.support.errors), ("not restored", report.unrestored)):
        for line in lines:
            console.print(Text(f"{what}: {line}", "bold red"), soft_wrap=True)
    if report.lost:
        console.print(Text(f"not completed: {report.lost}", "bold red"), soft_wrap=True)
    console.print(Text(summary(report), "bold green" if report.passed else "bold red"), soft_wrap=True)
    if report.folder:
        console.print(f"log, files and report.json: {report.folder}", markup=False, soft_wrap=True, style="dim")


def summary(report: CheckReport) -> str:
    """In one line."""
    counts = [f"{report.count(outcome)} {outcome.value}" for outcome in CheckOutcome if report.count(outcome)]
    unsupported = sum(told is None for told in report.support.parameters.values())
    unsupported += sum(has is False for has in report.support.actions.values())
    verdict = "the translator passes the suite" if report.passed else "the translator fails the suite"
    return f"{', '.join(counts) or 'nothing checked'}; {unsupported} actions and parameters not supported: {verdict}"


def _actions(report: CheckReport) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("action", "", "supported"):
        table.add_column(column)
    for name, has in report.support.actions.items():
        of_base = "base" if name in names.BASE_ACTIONS else ""
        said = {True: Text("yes", "green"), False: Text("no", "yellow"), None: Text("not reported", "yellow")}[has]
        table.add_row(name, of_base, said)
    return table


def _parameters(report: CheckReport) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("parameter", "", "supported", "at the beginning"):
        table.add_column(column)
    for name, told in report.support.parameters.items():
        of_base = "base" if name in names.BASE_PARAMETERS else ""
        if told is None:
            table.add_row(name, of_base, Text("no", "yellow"), "")
            continue
        settable = {True: "yes, set", False: "yes, read-only", None: "yes"}[report.support.settable.get(name)]
        table.add_row(name, of_base, Text(settable, "green"), f"{told.value} {told.unit or ''}".rstrip())
    return table
