"""The kernel of the conformance suites: outcomes, evidence, selection, and reports for people and programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
from rich.console import Console

from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import ConfigError
from afspm.testing.conformance import (
    REPORT_FILE,
    Check,
    CheckOutcome,
    CheckResult,
    Declined,
    Failed,
    Lost,
    Skipped,
    Suite,
    SuiteReport,
    Unsupported,
    attempt,
    counted,
    expect,
    show_failures,
    show_result,
    show_verdict,
)


class Bench:
    """A fixture that excuses the failure of one check as the controller's."""

    def __init__(self) -> None:
        self.clock: Clock = ExperimentClock.real()
        self.explained: list[str] = []

    def perform(self, check: Check) -> str | None:
        told: str | None = check.do(self)
        return told

    def explain(self, check: Check, failure: Failed) -> tuple[str, ...]:
        self.explained.append(check.name)
        if check.name == "excused":
            raise Skipped(f"not here: {failure}")
        return ("a warning", check.remedy)


def raising(error: Exception) -> Callable[[Bench], None]:
    def do(bench: Bench) -> None:
        raise error

    return do


def passes(bench: Bench) -> str:
    return "12 values"


FAILURE = Failed("a scan", "none")
OUTCOMES = [
    (Check("good", "t", passes), CheckOutcome.PASSED, "12 values"),
    (Check("bad", "t", raising(FAILURE)), CheckOutcome.FAILED, "expected a scan; came none"),
    (Check("excused", "t", raising(FAILURE)), CheckOutcome.SKIPPED, "not here: expected a scan; came none"),
    (Check("skipped", "t", raising(Skipped("no time"))), CheckOutcome.SKIPPED, "no time"),
    (Check("lacking", "t", raising(Unsupported("stop-scan"))), CheckOutcome.UNSUPPORTED, "stop-scan"),
    (Check("refused", "t", raising(Declined("not confirmed"))), CheckOutcome.DECLINED, "not confirmed"),
]


@pytest.mark.parametrize(("check", "outcome", "line"), OUTCOMES, ids=lambda one: getattr(one, "name", None))
def test_outcome_and_line_follow_from_the_exception_of_a_check(check: Check, outcome: CheckOutcome, line: str) -> None:
    bench = Bench()
    result = attempt(check, bench)
    assert (result.name, result.outcome, result.line) == (check.name, outcome, line)
    assert bench.explained == ([check.name] if check.name in ("bad", "excused") else [])
    assert bool(result.complaints) == (outcome is CheckOutcome.FAILED)


def test_lines_that_differ_in_numbers_are_counted_once() -> None:
    assert counted(["late by 3 s", "lost", "late by 41 s"]) == ["late by 3 s (2 times)", "lost"]


def test_error_of_a_check_itself_is_no_verdict() -> None:
    with pytest.raises(ZeroDivisionError):
        attempt(Check("wrong", "t", raising(ZeroDivisionError())), Bench())


def test_lost_ends_the_checks_and_stands_in_the_written_report(tmp_path: Path) -> None:
    report = SuiteReport(str(tmp_path))
    checks = [Check("good", "t", passes), Check("gone", "t", raising(Lost("the process ended"))), OUTCOMES[0][0]]
    with report.written():
        report.run(checks, Bench())
    assert [result.name for result in report.results] == ["good"]
    written = json.loads((tmp_path / REPORT_FILE).read_text(encoding="utf-8"))
    assert (written["lost"], written["passed"]) == ("the process ended", False)


def test_finished_checks_are_reported_after_an_interruption(tmp_path: Path) -> None:
    report = SuiteReport(str(tmp_path))

    def interrupt(bench: Bench) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), report.written():
        report.run([Check("good", "t", passes), Check("ctrl-c", "t", interrupt)], Bench())
    written = json.loads((tmp_path / REPORT_FILE).read_text(encoding="utf-8"))
    assert written["lost"] == "interrupted"
    assert [check["name"] for check in written["checks"]] == ["good"]


def test_checks_are_in_the_order_of_their_modules_and_chosen_by_parts_of_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    suite = Suite[Check]("afspm test-it", "suite_of_test", ["first", "second"])
    for module in ("suite_of_test.first", "suite_of_test.second"):
        monkeypatch.setitem(__import__("sys").modules, module, ModuleType(module))

    def check(module: str, name: str) -> None:
        def do(bench: Bench) -> None:
            return

        do.__module__ = f"suite_of_test.{module}"
        suite.add(Check(name, "t", do))

    for module, name in (("second", "scan/late"), ("first", "frame/set"), ("first", "frame/turn")):
        check(module, name)
    assert [one.name for one in suite.checks()] == ["frame/set", "frame/turn", "scan/late"]
    assert [one.name for one in suite.checks(["late", "turn"])] == ["frame/turn", "scan/late"]
    with pytest.raises(ConfigError, match="no check is called nothing") as error:
        suite.checks(["nothing"])
    assert error.value.hint == "afspm test-it --list"


def test_junit_report_counts_failures_skips_and_an_early_end(tmp_path: Path) -> None:
    report = SuiteReport()
    report.run([check for check, _, _ in OUTCOMES], Bench())
    report.lost = "control was taken away"
    file = tmp_path / "new" / "junit.xml"
    report.write(file)
    suite = ElementTree.parse(file).getroot()
    cases = {case.get("name"): [child.tag for child in case] for case in suite}
    assert (cases["good"], cases["bad"], cases["lacking"]) == ([], ["failure"], ["skipped"])
    assert cases["all checks are done"] == ["error"]
    failure = suite.find("testcase/failure")
    assert failure is not None
    assert failure.get("message") == "expected a scan; came none"
    assert "a warning" in (failure.text or "")


def test_terminal_shows_line_and_evidence_of_a_failure_and_the_verdict() -> None:
    console = Console(width=200, record=True, highlight=False)
    report = SuiteReport("runs/one")
    report.run([check for check, _, _ in OUTCOMES[:3]], Bench(), lambda result: show_result(result, console))
    show_verdict(report, ": it fails", console)
    text = console.export_text()
    assert "✗ bad" in text
    assert "    expected a scan; came none\n    a warning\n" in text
    assert "1 passed, 1 failed, 1 skipped: it fails" in text
    assert "report.json: runs/one" in text


def failed(name: str, failure: Failed, *complaints: str) -> CheckResult:
    return CheckResult(name, "t", CheckOutcome.FAILED, str(failure), 0.0, complaints, failure.expected, failure.came)


def test_recurring_failure_refers_to_its_first_check_and_another_one_is_shown_whole() -> None:
    console = Console(width=200, record=True, highlight=False)
    results = [
        failed("first", FAILURE, "scan1.npz can't be read"),
        failed("again", FAILURE, "scan2.npz can't be read"),
        failed("other", FAILURE, "scan3.npz is empty"),
        failed("else", Failed("a scan", "2 scans"), "scan4.npz can't be read"),
    ]
    for number, result in enumerate(results):
        show_result(result, console, results[: number + 1])
    shown = [line.strip() for line in console.export_text().splitlines()]
    assert [line for line in shown if line[0] not in "✗"] == [
        "expected a scan; came none",
        "scan1.npz can't be read",
        "for the same reason as first",
        "expected a scan; came none",
        "scan3.npz is empty",
        "expected a scan; came 2 scans",
        "scan4.npz can't be read",
    ]


def test_list_of_failures_gives_each_observation_once_with_the_checks_and_their_expectations() -> None:
    console = Console(width=200, record=True, highlight=False)
    refused = "REP_PARAM_ERROR (KeyError: 'X')"
    results = [
        failed("frame/set", Failed("a new frame", refused)),
        failed("scan/order", FAILURE),
        failed("frame/turned", Failed("a new frame", refused)),
        failed("probe/move", Failed("a move", refused)),
    ]
    show_failures(results, console)
    assert console.export_text().splitlines() == [
        f"✗ came {refused}",
        "    frame/set, frame/turned: expected a new frame",
        "    probe/move: expected a move",
        "✗ scan/order: expected a scan; came none",
    ]


def test_nothing_checked_is_not_passed() -> None:
    assert not SuiteReport().passed
    with pytest.raises(Failed, match="expected one; came two"):
        expect([], "one", "two")
