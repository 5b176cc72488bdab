"""The conformance page of clients lists all checks."""

from __future__ import annotations

from pathlib import Path

from afspm.testing.clients.client_suite import CLIENT_SUITE

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "client-conformance.md"


def test_table_matches_the_checks() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `") and "/" in line]
    checks = [f"| `{one.name}` | {one.title} | {one.remedy} |" for one in CLIENT_SUITE.checks()]
    assert [row for row in rows if row.split("`")[1].count("/") == 1 and row in checks] == checks
    assert len(checks) >= 30
