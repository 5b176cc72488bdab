"""A pass in the terminal: a line for each check, and at the end what is supported and what is not."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from afspm.model import names
from afspm.testing.translators.report import Outcome, Report, Result

_MARKS = {
    Outcome.PASSED: ("✓", "green"),
    Outcome.FAILED: ("✗", "bold red"),
    Outcome.SKIPPED: ("–", "yellow"),
}
_NAME_WIDTH = 29


def show_beginning(report: Report, console: Console) -> None:
    """What is checked, before it is."""
    told = report.support.controller or "its controller does not tell its version"
    simulated = " SIMULATED" if report.simulated else ""
    console.print(Text.assemble((report.translator, "bold"), f": {told}", (simulated, "bold yellow")), soft_wrap=True)


def show_result(result: Result, console: Console) -> None:
    """One check; what was expected and what came below it."""
    mark, style = _MARKS[result.outcome]
    line = Text.assemble((mark, style), f" {result.name:{_NAME_WIDTH}} ", (result.title, "dim"))
    for told in filter(None, (result.line, *result.complaints)):
        line.append(f"\n    {told}", style)
    console.print(line, soft_wrap=True)


def show_end(report: Report, console: Console) -> None:
    """The tables, and what came of it all."""
    console.print(_actions(report))
    console.print(_parameters(report))
    for failure in report.failed:
        console.print(Text.assemble(("✗ ", "bold red"), f"{failure.name}: {failure.line}"), soft_wrap=True)
    for what, lines in (("wrong answer", report.support.errors), ("not restored", report.unrestored)):
        for line in lines:
            console.print(Text(f"{what}: {line}", "bold red"), soft_wrap=True)
    if report.lost:
        console.print(Text(f"not finished: {report.lost}", "bold red"), soft_wrap=True)
    console.print(Text(summary(report), "bold green" if report.passed else "bold red"), soft_wrap=True)
    if report.folder:
        console.print(f"log, files and report.json: {report.folder}", markup=False, soft_wrap=True, style="dim")


def summary(report: Report) -> str:
    """In one line."""
    counts = [f"{report.count(outcome)} {outcome.value}" for outcome in Outcome if report.count(outcome)]
    unsupported = sum(told is None for told in report.support.parameters.values())
    unsupported += sum(has is False for has in report.support.actions.values())
    verdict = "the translator does what it should" if report.passed else "the translator does not do what it should"
    return f"{', '.join(counts) or 'nothing checked'}; {unsupported} actions and parameters not supported: {verdict}"


def _actions(report: Report) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("action", "", "supported"):
        table.add_column(column)
    for name, has in report.support.actions.items():
        of_base = "base" if name in names.BASE_ACTIONS else ""
        said = {True: Text("yes", "green"), False: Text("no", "yellow"), None: Text("it does not say", "yellow")}[has]
        table.add_row(name, of_base, said)
    return table


def _parameters(report: Report) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("parameter", "", "supported", "at the beginning"):
        table.add_column(column)
    for name, told in report.support.parameters.items():
        of_base = "base" if name in names.BASE_PARAMETERS else ""
        if told is None:
            table.add_row(name, of_base, Text("no", "yellow"), "")
            continue
        settable = {True: "yes, set", False: "yes, only read", None: "yes"}[report.support.settable.get(name)]
        table.add_row(name, of_base, Text(settable, "green"), f"{told.value} {told.unit or ''}".rstrip())
    return table
