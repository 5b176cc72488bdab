"""The report of all checks, as text and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from afspm.model import names
from afspm.testing.conformance import SuiteReport, counted, show_failures, show_verdict
from afspm.testing.translators.session import CheckSession
from afspm.testing.translators.support import Support


@dataclass
class CheckReport(SuiteReport):
    """The results of all checks of one translator.

    Attributes:
        translator: class or command of the translator.
        unrestored: settings that could not be restored, one per line.
        complaints: the logged warnings and errors; the list grows.
    """

    translator: str = ""
    simulated: bool = False
    support: Support = field(default_factory=Support)
    unrestored: list[str] = field(default_factory=list)
    complaints: Sequence[str] = ()

    def describe(self, session: CheckSession) -> None:
        """Record the facts about the translator under test."""
        self.translator, self.simulated = session.translator, session.simulated
        self.support, self.folder, self.complaints = session.support, str(session.folder), session.complaints

    @property
    def passed(self) -> bool:
        return super().passed and not (self.unrestored or self.support.errors)

    def subject(self) -> dict[str, object]:
        return {
            "translator": self.translator,
            "controller": self.support.controller,
            "simulated": self.simulated,
            "unrestored": self.unrestored,
            "wrong_answers": self.support.errors,
            "logged": counted(self.complaints),
            "actions": [{"name": name, "supported": has} for name, has in self.support.actions.items()],
            "parameters": [self._parameter(name) for name in self.support.parameters],
        }

    def _parameter(self, name: str) -> dict[str, object]:
        parameter = self.support.parameters[name]
        return {
            "name": name,
            "supported": parameter is not None,
            "value": None if parameter is None else parameter.value,
            "unit": None if parameter is None else parameter.unit,
            "settable": self.support.settable.get(name),
        }


def show_beginning(report: CheckReport, console: Console) -> None:
    """Print the translator under test."""
    controller = report.support.controller or "its controller does not report its version"
    simulated = " SIMULATED" if report.simulated else ""
    console.print(
        Text.assemble((report.translator, "bold"), f": {controller}", (simulated, "bold yellow")), soft_wrap=True
    )


def show_end(report: CheckReport, console: Console) -> None:
    """Print the tables and the verdict."""
    if report.support.parameters:  # else the microscope could not be queried
        console.print(_actions(report))
        console.print(_parameters(report))
    show_failures(report.failed, console)
    for what, lines in (("wrong answer", report.support.errors), ("not restored", report.unrestored)):
        for line in lines:
            console.print(Text(f"{what}: {line}", "bold red"), soft_wrap=True)
    for line in counted(report.complaints):
        console.print(Text(f"logged: {line}", "yellow"), soft_wrap=True)
    unsupported = sum(value is None for value in report.support.parameters.values())
    unsupported += sum(has is False for has in report.support.actions.values())
    verdict = "the translator passes the suite" if report.passed else "the translator fails the suite"
    show_verdict(report, f"; {unsupported} actions and parameters not supported: {verdict}", console)


def _actions(report: CheckReport) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("action", "", "supported"):
        table.add_column(column)
    for name, has in report.support.actions.items():
        of_base = "base" if name in names.BASE_ACTIONS else ""
        supported = {True: Text("yes", "green"), False: Text("no", "yellow"), None: Text("not reported", "yellow")}[has]
        table.add_row(name, of_base, supported)
    return table


def _parameters(report: CheckReport) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for column in ("parameter", "", "supported", "at the beginning"):
        table.add_column(column)
    for name, parameter in report.support.parameters.items():
        of_base = "base" if name in names.BASE_PARAMETERS else ""
        if parameter is None:
            table.add_row(name, of_base, Text("no", "yellow"), "")
            continue
        settable = {True: "yes, set", False: "yes, read-only", None: "yes"}[report.support.settable.get(name)]
        table.add_row(name, of_base, Text(settable, "green"), f"{parameter.value} {parameter.unit or ''}".rstrip())
    return table
