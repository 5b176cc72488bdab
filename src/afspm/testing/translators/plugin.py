"""A pytest plugin: an experiment file named on pytest's command line becomes a test for each check.

    pytest -p afspm.testing.translators.plugin experiment.toml [--overlay FILE] [--without-process NAME]

The plugin is not loaded automatically, so that other tests in an environment with afspm are not disturbed. In the tests
of a translator's package: `addopts = ["-p", "afspm.testing.translators.plugin"]` and `testpaths = ["tests",
"experiment.toml"]`. The checks assume that the tip is withdrawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from afspm.testing.conformance import REPORT_FILE, Check, CheckOutcome, Lost, attempt
from afspm.testing.translators import runner, session
from afspm.testing.translators.measuring import CheckMeasurements
from afspm.testing.translators.report import CheckReport
from afspm.testing.translators.translator_suite import TRANSLATOR_SUITE

_REPORTS = pytest.StashKey[list[CheckReport]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("afspm translators")
    group.addoption("--overlay", action="append", default=[], metavar="FILE", help="merged over the experiment file")
    group.addoption(
        "--without-process", action="append", default=[], metavar="NAME", help="is already running: join it"
    )
    group.addoption("--runs", default="runs", metavar="DIR", help="the folder in which to make the run's folder")


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect an experiment file named on the command line, and no other TOML file."""
    if file_path.suffix == ".toml" and parent.session.isinitpath(file_path):
        return ExperimentFile.from_parent(parent, path=file_path)
    return None


class ExperimentFile(pytest.File):
    """The checks of one experiment file, which share one run of its processes."""

    def collect(self) -> Iterable[pytest.Item]:
        for check in TRANSLATOR_SUITE.checks():
            yield CheckItem.from_parent(self, name=check.name, check=check)

    def setup(self) -> None:
        option = self.config.option
        self._stack = ExitStack()
        self.report = CheckReport()
        self.config.stash.setdefault(_REPORTS, []).append(self.report)
        options = session.CheckOptions(
            (self.path, *map(Path, option.overlay)), option.without_process, Path(option.runs)
        )
        try:
            opened = self._stack.enter_context(session.opened(options))
        except Lost as lost:
            self.report.lost = str(lost)
            pytest.fail(str(lost), pytrace=False)
        self.report.describe(opened)
        self.kit: CheckMeasurements = self._stack.enter_context(runner.restored(opened, self.report))

    def teardown(self) -> None:
        self._stack.close()
        if self.report.folder:
            self.report.write(Path(self.report.folder) / REPORT_FILE)
        if self.report.unrestored:
            pytest.fail("not restored: " + "; ".join(self.report.unrestored), pytrace=False)


class CheckItem(pytest.Item):
    """A check as a pytest item."""

    def __init__(self, *, check: Check, **given: Any) -> None:
        super().__init__(**given)
        self._check = check

    def runtest(self) -> None:
        assert isinstance(self.parent, ExperimentFile)
        report = self.parent.report
        if report.lost:
            pytest.fail(report.lost, pytrace=False)
        try:
            result = attempt(self._check, self.parent.kit)
        except Lost as lost:
            report.lost = str(lost)
            pytest.fail(report.lost, pytrace=False)
        report.results.append(result)
        if result.outcome is CheckOutcome.SKIPPED:
            pytest.skip(result.line)
        if result.outcome is CheckOutcome.FAILED:
            pytest.fail("\n".join((result.line, *result.complaints)), pytrace=False)

    def reportinfo(self) -> tuple[Path, None, str]:
        return self.path, None, f"{self._check.name}: {self._check.title}"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Print the supported and unsupported operations."""
    from rich.console import Console

    from afspm.testing.translators.report import show_end

    for report in config.stash.get(_REPORTS, []):
        console = Console(width=120, highlight=False)
        with console.capture() as capture:
            show_end(report, console)
        terminalreporter.section(report.translator or "translator")
        terminalreporter.write(capture.get())
