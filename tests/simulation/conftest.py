"""The score of the mutants, at the end of a run that tried them."""

from __future__ import annotations

import pytest

_MUTANT = "test_a_broken_scheduler_is_found"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    count = {
        outcome: sum(_MUTANT in report.nodeid for report in terminalreporter.stats.get(outcome, ()))
        for outcome in ("passed", "failed")
    }
    if total := sum(count.values()):
        terminalreporter.write_line(f"mutants found: {count['passed']} of {total}")
