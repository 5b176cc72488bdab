"""The report on a client, as text and as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

from rich.console import Console
from rich.text import Text

from afspm.testing.verdicts import CheckOutcome, CheckResult


@dataclass
class ClientReport:
    """The results of all checks of one client.

    Attributes:
        command: the conformance program and its arguments.
        lost: why the checks could not be finished; empty if they were.
        folder: with the log of the program, and the runs.
    """

    command: Sequence[str]
    afspm: str
    began: str
    folder: str
    results: list[CheckResult] = field(default_factory=list)
    lost: str = ""

    @property
    def passed(self) -> bool:
        """True if nothing was wrong."""
        return bool(self.results) and not self.failed and not self.lost

    @property
    def failed(self) -> list[CheckResult]:
        return [result for result in self.results if result.outcome is CheckOutcome.FAILED]

    def to_json(self) -> str:
        """For programs."""
        facts = {
            "passed": self.passed,
            "command": list(self.command),
            "afspm": self.afspm,
            "began": self.began,
            "lost": self.lost,
            "checks": [{**asdict(result), "outcome": result.outcome.value} for result in self.results],
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"


def show_client_end(report: ClientReport, console: Console) -> None:
    """Print what came of it all."""
    if report.lost:
        console.print(Text(f"not finished: {report.lost}", "bold red"), soft_wrap=True)
    passed = sum(result.outcome is CheckOutcome.PASSED for result in report.results)
    counts = f"{passed} passed, {len(report.failed)} failed"
    verdict = "the client does what it should" if report.passed else "the client does not do what it should"
    console.print(Text(f"{counts}: {verdict}", "bold green" if report.passed else "bold red"), soft_wrap=True)
    console.print(f"logs and report.json: {report.folder}", markup=False, soft_wrap=True, style="dim")
