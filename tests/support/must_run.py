"""`pytest --must-run`: for targets with tests that need a program; they fail if not one test ran.

With AFSPM_LACKING=passes, as in `.ci/run`, they name what the computer lacks, and pass.
"""

from __future__ import annotations

import os
from typing import Any, Final

import pytest

RAN: Final = ("passed", "failed", "error", "xfailed", "xpassed")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--must-run", action="store_true", help="fail if all tests are skipped")


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail if no test ran; a process that runs tests for another one does not judge."""
    config: Any = session.config
    if not config.getoption("must_run") or hasattr(config, "workerinput") or _has_run(config):
        return
    lacking = config.pluginmanager.get_plugin("terminalreporter").stats.get("skipped")
    passes = lacking and os.environ.get("AFSPM_LACKING") == "passes"
    session.exitstatus = pytest.ExitCode.OK if passes else pytest.ExitCode.NO_TESTS_COLLECTED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    if config.getoption("must_run") and not _has_run(config):
        terminalreporter.write_line("no test ran: install what the reasons above name, and run this again", red=True)


def _has_run(config: Any) -> bool:
    stats = config.pluginmanager.get_plugin("terminalreporter").stats
    return any(stats.get(outcome) for outcome in RAN)
