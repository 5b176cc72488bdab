"""A table of the processor time of each folder of tests, and of the most expensive tests: `pytest --processor-times`.

A test's time is that of its process, and of the children that ended while it ran. What belongs to no test (imports,
collection, fixtures of a whole session that ended later) is in `make test`'s total alone.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Generator
from typing import Any, Final

import pytest

EXPENSIVE: Final = 10
"""As many tests are listed."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--processor-times", action="store_true", help="list the processor time of folders and tests")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("processor_times"):
        config.pluginmanager.register(ProcessorTimes(), "processor_times")


class ProcessorTimes:
    """Processor time by test, measured by the process that runs it and summed by the one that reports."""

    def __init__(self) -> None:
        self._spent_s: dict[str, float] = defaultdict(float)
        self._last_s = _now_s()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_logstart(self) -> None:
        self._last_s = _now_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, Any, Any]:
        report = yield
        now_s = _now_s()
        # an attribute of a report reaches the reporting process along with it
        report.processor_s = now_s - self._last_s
        self._last_s = now_s
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._spent_s[report.nodeid] += getattr(report, "processor_s", 0.0)

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        folders: dict[str, float] = defaultdict(float)
        for test, spent_s in self._spent_s.items():
            folders[_folder(test)] += spent_s
        terminalreporter.section("processor time in s")
        for folder, spent_s in _dearest_first(folders):
            terminalreporter.write_line(f"{spent_s:8.1f}  {folder}")
        terminalreporter.write_line(f"{sum(folders.values()):8.1f}  all tests; the {EXPENSIVE} most expensive of them:")
        for test, spent_s in _dearest_first(self._spent_s)[:EXPENSIVE]:
            terminalreporter.write_line(f"{spent_s:8.1f}  {test}")


def _now_s() -> float:
    """Return the processor time of this process and of its ended children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _folder(test: str) -> str:
    return "/".join(test.partition("::")[0].split("/")[:-1])


def _dearest_first(spent_s: dict[str, float]) -> list[tuple[str, float]]:
    return sorted(spent_s.items(), key=lambda each: -each[1])
