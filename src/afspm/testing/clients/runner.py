"""The run of all checks of a client, in order, and its report."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.console import Console

from afspm.basics.clock import ExperimentClock
from afspm.supervisor import run_folder
from afspm.testing.clients.bench import ClientBench
from afspm.testing.clients.client_suite import CLIENT_SUITE
from afspm.testing.conformance import CheckResult, SuiteReport, show_verdict


@dataclass
class ClientReport(SuiteReport):
    """The results of all checks of one client.

    Attributes:
        command: the conformance program and its arguments.
    """

    command: Sequence[str] = ()

    def subject(self) -> dict[str, object]:
        return {"command": list(self.command)}


def judge(
    command: Sequence[str],
    runs: Path,
    only: Collection[str] = (),
    done: Callable[[CheckResult], None] = lambda result: None,
) -> ClientReport:
    """Run the selected checks, and write `report.json` into a new folder in `runs`.

    Args:
        command: the client's conformance program, and its arguments.
        only: parts of the names of the checks; empty: all.
        done: called with each result.

    Raises:
        ConfigError: the program can't be started, or no check has such a name.
    """
    checks = CLIENT_SUITE.checks(only)
    folder = run_folder.create(runs, "test-client", datetime.fromtimestamp(ExperimentClock.real().now_s()).astimezone())
    report = ClientReport(str(folder), command=command)
    with report.written(), ClientBench(command, folder) as bench:
        report.run(checks, bench, done)
    return report


def show_client_end(report: ClientReport, console: Console) -> None:
    """Print the verdict."""
    does = "does" if report.passed else "does not do"
    show_verdict(report, f": the client {does} what it should", console)
