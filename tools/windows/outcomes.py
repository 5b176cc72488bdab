"""A plugin of pytest that writes what becomes of each test into the file AFSPM_OUTCOMES, one JSON array a line.

A test that is in the file already is left out: after a crash, the same command goes on behind the test that crashed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

FILE = Path(os.environ["AFSPM_OUTCOMES"]).absolute()  # tests change to other folders, and to another drive


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    begun = {test for what, test, *_ in read(FILE) if what == "begun"}
    items[:] = [item for item in items if item.nodeid not in begun]


def pytest_collectreport(report: pytest.CollectReport) -> None:
    if not report.passed:
        _write(report.outcome, report.nodeid, _reason(report))


def pytest_runtest_logstart(nodeid: str) -> None:
    _write("begun", nodeid)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.when == "call" or not report.passed:
        _write(report.outcome, report.nodeid, _reason(report))


def pytest_runtest_logfinish(nodeid: str) -> None:
    _write("finished", nodeid)


def pytest_sessionfinish() -> None:
    _write("ended", "")


def read(file: Path) -> list[list[str]]:
    """Return the lines of such a file: what became of a test, its name, and why where it was skipped or failed."""
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []


def _reason(report: Any) -> str:
    if not report.skipped:
        return ""
    return str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else str(report.longrepr)


def _write(*what: str) -> None:
    with FILE.open("a", encoding="utf-8") as file:
        file.write(json.dumps(what) + "\n")
