"""The conformance kernel: checks of a translator, a client or a controller, done one after the other.

**Theory of operation.** A `Suite` collects the checks of one kind of program, in order. A `Check` contains a function
of the suite's fixture, which raises a `CheckEnded` unless the program passes. `attempt` runs a check and returns a
`CheckResult`; `SuiteReport.run` runs several. The surroundings of a check differ from suite to suite (a question to a
person, a new experiment after a failure): they are in the fixture's `perform` and `explain`. Each wait within a check
has its own time limit, so that a check ends even if the program does not answer. A limit for a whole check could only
cut a controller's connection in the middle of a request. The suites share this kernel, since their own three differed
by accident: after a lost process, the report on a translator could say `"passed": true`.

| raised | because | outcome | then |
| --- | --- | --- | --- |
| `Failed` | the program does something else | failed | `explain` adds evidence; next check |
| `Skipped`, `Unsupported`, `Declined` | there is nothing to check here | of that name | next check |
| `Lost` | a process has ended, or control was taken away | none | no further check; the report says why |
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from enum import Enum
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar, Generic, Protocol, TypeVar
from xml.etree import ElementTree

from rich.console import Console
from rich.text import Text

from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import ConfigError

NAME_WIDTH = 29
REPORT_FILE = "report.json"


class CheckOutcome(Enum):
    """The outcome of a check; `BLOCKED` if a required check has not passed."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"
    UNSUPPORTED = "not supported"
    DECLINED = "declined"
    BLOCKED = "blocked"


class CheckEnded(Exception):
    """The exception that ends a check that has not passed; its text is the line of the result."""

    outcome: ClassVar[CheckOutcome]


class Failed(CheckEnded, AssertionError):
    """The exception that the program under test behaves differently from the requirement.

    Args:
        expected, came: expectation and observation in a physicist's words, without a full stop.
    """

    outcome = CheckOutcome.FAILED

    def __init__(self, expected: str, came: str) -> None:
        super().__init__(f"expected {expected}; came {came}")
        self.expected, self.came = expected, came


class Skipped(CheckEnded):
    """The exception that a check is impossible here; its text gives the reason."""

    outcome = CheckOutcome.SKIPPED


class Unsupported(CheckEnded):
    """The exception that the program lacks a feature that the check needs; its text names the feature."""

    outcome = CheckOutcome.UNSUPPORTED


class Declined(CheckEnded):
    """The exception that the person did not confirm; nothing was done."""

    outcome = CheckOutcome.DECLINED


class Lost(Exception):
    """The exception that no further check is possible: a process has ended, or control was taken away."""


@dataclass(frozen=True)
class CheckResult:
    """The result of one check.

    Attributes:
        line: expectation and observation, or the reason for skipping.
        complaints: the evidence of a failed check: warnings and errors logged meanwhile, the remedy.
        real_s: duration of the check.
        expected, came: both halves of the line of a failed check.
    """

    name: str
    title: str
    outcome: CheckOutcome
    line: str = ""
    real_s: float = 0.0
    complaints: tuple[str, ...] = ()
    expected: str = ""
    came: str = ""

    @property
    def evidence(self) -> tuple[str, ...]:
        """The line and the complaints of a failed check without their numbers, which differ when a failure recurs."""
        return (self.line, *(re.sub(r"\d+", "#", text) for text in self.complaints))


def counted(lines: Iterable[str]) -> list[str]:
    """Return each line once, with its number of occurrences; lines that differ only in numbers count as equal."""
    found: dict[str, list[str]] = {}
    for line in lines:
        found.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    return [same[0] + (f" ({len(same)} times)" if len(same) > 1 else "") for same in found.values()]


def expect(holds: object, expected: str, came: str) -> None:
    if not holds:
        raise Failed(expected, came)


def near(a: float, b: float, relative: float = 1e-3, absolute: float = 0.0) -> bool:
    """Return whether two numbers agree within `relative` or `absolute`: by default a controller's precision, 0.1 %."""
    return math.isclose(a, b, rel_tol=relative, abs_tol=absolute)


@dataclass(frozen=True)
class Check:
    """A requirement and the function that checks it.

    Attributes:
        name: "scan/cancel": the subject, and the requirement.
        title: a sentence that is true of a program that passes.
        do: takes the suite's fixture; raises a CheckEnded, or returns a remark on a pass.
        needs: actions and parameters required by the check.
        remedy: advice for a failed check.
    """

    name: str
    title: str
    do: Callable[..., str | None]
    needs: tuple[str, ...] = ()
    remedy: str = ""

    @property
    def listed(self) -> str:
        """The line in a list of all checks."""
        return f"{self.name:{NAME_WIDTH + 2}}{self.title}"


K = TypeVar("K", bound=Check)
K_contra = TypeVar("K_contra", bound=Check, contravariant=True)


class Suite(Generic[K]):
    """The checks of one kind of program, in order.

    Args:
        command: the command that runs the suite.
        package: the package with the modules of checks, which are imported on first use.
        modules: the names of the modules, in order.
    """

    def __init__(self, command: str, package: str, modules: Sequence[str]) -> None:
        self._command = command
        self._modules = [f"{package}.{module}" for module in modules]
        self._checks: list[K] = []

    def add(self, check: K) -> None:
        """Add a check; the checks of a module run in the order of their addition."""
        self._checks.append(check)

    def checks(self, only: Collection[str] = ()) -> tuple[K, ...]:
        """Return the checks whose names contain a text in `only`; all checks if `only` is empty.

        Raises:
            ConfigError: no check has such a name.
        """
        for module in self._modules:
            import_module(module)
        # modules may have been imported in any order, by a test or by each other
        ordered = sorted(self._checks, key=lambda one: self._modules.index(one.do.__module__))
        found = tuple(one for one in ordered if not only or any(part in one.name for part in only))
        if not found:
            raise ConfigError(f"no check is called {' or '.join(only)}", hint=f"{self._command} --list")
        return found


class Fixture(Protocol[K_contra]):
    """The environment of the checks of a suite."""

    @property
    def clock(self) -> Clock:
        """The clock for the durations of checks."""

    def perform(self, check: K_contra) -> str | None:
        """Run a check, unless it is impossible. Raises CheckEnded, Lost."""

    def explain(self, check: K_contra, failure: Failed) -> tuple[str, ...]:
        """Return the evidence of a failure, and prepare the next check.

        Raises:
            Skipped: the program is not at fault.
            Lost: no further check is possible.
        """


def attempt(check: K, fixture: Fixture[K]) -> CheckResult:
    """Run one check.

    Raises:
        Lost: no further check is possible.
    """
    began_s = fixture.clock.monotonic_s()
    outcome, line = CheckOutcome.PASSED, ""
    expected, came = "", ""
    complaints: tuple[str, ...] = ()
    try:
        try:
            line = fixture.perform(check) or ""
        except Failed as failure:
            complaints = fixture.explain(check, failure)
            outcome, line = failure.outcome, str(failure)
            expected, came = failure.expected, failure.came
    except CheckEnded as verdict:
        outcome, line = verdict.outcome, str(verdict)
    real_s = fixture.clock.monotonic_s() - began_s
    return CheckResult(check.name, check.title, outcome, line, real_s, complaints, expected, came)


@dataclass
class SuiteReport:
    """The results of a suite, for one program.

    Attributes:
        lost: the reason for unfinished checks; empty if all were finished.
        folder: folder of this run, with its log and files; empty before it is created.
    """

    folder: str = ""
    results: list[CheckResult] = field(default_factory=list)
    lost: str = ""
    afspm: str = field(default_factory=lambda: version("afspm"))
    began: str = field(default_factory=lambda: _now().isoformat(timespec="seconds"))

    @property
    def passed(self) -> bool:
        """True if checks ran, none failed and none was prevented by a lost process."""
        return bool(self.results) and not (self.failed or self.lost)

    @property
    def failed(self) -> list[CheckResult]:
        return [result for result in self.results if result.outcome is CheckOutcome.FAILED]

    @property
    def counts(self) -> str:
        """The numbers of outcomes, in words."""
        count = Counter(result.outcome for result in self.results)
        return ", ".join(f"{count[outcome]} {outcome.value}" for outcome in CheckOutcome if count[outcome])

    def subject(self) -> dict[str, object]:
        """Return the facts about the program under test, for `to_json`."""
        return {}

    def to_json(self) -> str:
        """Return the report as JSON: `passed`, the checks, and the facts about the program."""
        facts: dict[str, object] = {
            "passed": self.passed,
            "afspm": self.afspm,
            "began": self.began,
            "lost": self.lost,
            "checks": [{**asdict(result), "outcome": result.outcome.value} for result in self.results],
            **self.subject(),
        }
        return json.dumps(facts, indent=2, ensure_ascii=False) + "\n"

    def to_junit(self) -> str:
        """Return the report as JUnit's XML, for test services."""
        suite = ElementTree.Element("testsuite", name="afspm", timestamp=self.began, tests=str(len(self.results)))
        for result in self.results:
            group, _, name = result.name.rpartition("/")
            facts = {"classname": group, "name": name, "time": f"{result.real_s:.3f}"}
            case = ElementTree.SubElement(suite, "testcase", facts)
            if result.outcome is CheckOutcome.FAILED:
                ElementTree.SubElement(case, "failure", message=result.line).text = "\n".join(result.complaints)
            elif result.outcome is not CheckOutcome.PASSED:
                ElementTree.SubElement(case, "skipped", message=result.line)
        if self.lost:
            lost = ElementTree.SubElement(suite, "testcase", classname="", name="all checks are done")
            ElementTree.SubElement(lost, "error", message=self.lost)
        ElementTree.indent(suite)
        return ElementTree.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"

    def write(self, file: Path) -> None:
        """Write the report into a file: JUnit's XML if its name ends with `.xml`, else JSON."""
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(self.to_junit() if file.suffix == ".xml" else self.to_json(), encoding="utf-8")

    @contextmanager
    def written(self) -> Iterator[None]:
        """Write `report.json` at the end of the `with` block.

        `Lost` ends the block without an error; the report contains the reason.
        """
        try:
            yield
        except Lost as lost:
            self.lost = str(lost)
        except KeyboardInterrupt:
            self.lost = "interrupted"
            raise
        finally:
            if self.folder:
                self.write(Path(self.folder) / REPORT_FILE)

    def run(
        self, checks: Iterable[K], fixture: Fixture[K], done: Callable[[CheckResult], None] = lambda result: None
    ) -> None:
        """Run checks in order; `done` is called with each result.

        Raises:
            Lost: no further check is possible.
        """
        for check in checks:
            result = attempt(check, fixture)
            self.results.append(result)
            done(result)


def _now() -> datetime:
    return datetime.fromtimestamp(ExperimentClock.real().now_s(), UTC)


_FAILED = ("✗", "bold red")
_OTHERWISE = ("–", "yellow")
_MARKS = {CheckOutcome.PASSED: ("✓", "green"), CheckOutcome.FAILED: _FAILED}


def mark(outcome: CheckOutcome) -> tuple[str, str]:
    """Return the symbol of an outcome, and its style in a terminal."""
    return _MARKS.get(outcome, _OTHERWISE)


def show_result(result: CheckResult, console: Console, earlier: Iterable[CheckResult] = ()) -> None:
    """Print a check's result, with its line and complaints below.

    A failure with the evidence of an `earlier` result is shown as a reference to the earlier check.
    """
    symbol, style = mark(result.outcome)
    text = Text.assemble((symbol, style), f" {result.name:{NAME_WIDTH}} ", (result.title, "dim"))
    lines = (result.line, *result.complaints)
    if result.outcome is CheckOutcome.FAILED:
        same = (one.name for one in earlier if one is not result and one.evidence == result.evidence)
        if first := next(same, None):
            lines = (f"for the same reason as {first}",)
    for line in filter(None, lines):
        text.append(f"\n    {line}", style)
    console.print(text, soft_wrap=True)


def show_failures(failed: Sequence[CheckResult], console: Console) -> None:
    """Print each observation of failed checks once, with the names of these checks and their expectations."""
    reasons: dict[str, dict[str, list[str]]] = {}
    for result in failed:
        reasons.setdefault(result.came, {}).setdefault(result.expected, []).append(result.name)
    for came, expectations in reasons.items():
        lines = [f"{', '.join(names)}: expected {expected}" for expected, names in expectations.items()]
        reason = f"{lines[0]}; came {came}" if len(lines) == 1 else "\n    ".join((f"came {came}", *lines))
        console.print(Text.assemble(("✗ ", "bold red"), reason), soft_wrap=True)


def show_verdict(report: SuiteReport, verdict: str, console: Console) -> None:
    """Print the verdict of all checks on one line, and the run folder."""
    if report.lost:
        console.print(Text(f"not completed: {report.lost}", "bold red"), soft_wrap=True)
    line = f"{report.counts or 'nothing checked'}{verdict}"
    console.print(Text(line, "bold green" if report.passed else "bold red"), soft_wrap=True)
    if report.folder:
        line = f"log, files and {REPORT_FILE}: {report.folder}"
        console.print(line, markup=False, soft_wrap=True, style="dim")
