"""The judge of clients: it passes a correct one, and finds what is broken on purpose in each of the others."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.testing.clients import judge
from afspm.testing.conformance import CheckOutcome

PROGRAM = (sys.executable, str(Path(__file__).with_name("conformance_program.py")))


def failures(tmp_path: Path, *only: str, broken: str = "") -> dict[str, str]:
    report = judge([*PROGRAM, *filter(None, [broken])], tmp_path, only)
    assert not report.lost
    return {result.name: result.line for result in report.failed}


@pytest.mark.parametrize(
    "group", ["wire/", "launch/", "replay/", "requests/re", "measure/", "control/", "faults/", "keys/"]
)
def test_a_correct_client_passes(tmp_path: Path, group: str) -> None:
    assert failures(tmp_path, group) == {}


def test_a_correct_client_passes_with_1000_requests_whose_replies_get_lost(tmp_path: Path) -> None:
    report = judge(PROGRAM, tmp_path, ["lost-replies", "other-answers"])
    assert not report.failed
    told = next(result.line for result in report.results if result.name == "requests/lost-replies")
    assert int(told.split()[0]) > 20


@pytest.mark.parametrize(
    ("broken", "check", "said"),
    [
        ("echoes", "wire/decode", "scan parameters with the fields"),
        ("drops-zeros", "wire/encode", "expected .* as "),
        ("loses-the-order", "wire/packets", "all values, in their order"),
        ("ends-over-bad-packets", "wire/bad-packets", "the end of the program"),
        ("no-token", "launch/heartbeats", "beat_token"),
        ("rare-beats", "launch/heartbeats", "a pause of"),
        ("ignores-kill", "launch/end", "a program that goes on"),
        ("no-marker", "replay/marker", "a subscription to a marker"),
        ("all-anew", "replay/reconnect", "newer than"),
        ("new-ids", "requests/repeat", "repetitions with the id of the first"),
        ("new-ids", "requests/lost-replies", r"each executed once; came (1[1-9]|[2-9]\d)\d\d that were executed"),
        ("any-answer", "requests/other-answers", "the success that has the request's id"),
        ("same-life", "requests/restart", "its id was used for another request before"),
        ("drops-units", "measure/parameters", "expected"),
        ("deaf-to-control", "control/manual", "the client to know that in_control = False"),
        ("gives-up-scans", "control/repair", "the scan to be taken"),
        ("ignores-keys", "keys/impostor", "silence towards a scheduler with no key"),
    ],
)
def test_a_broken_client_is_found(tmp_path: Path, broken: str, check: str, said: str) -> None:

    found = failures(tmp_path, check, broken=broken)
    assert list(found) == [check]
    assert re.search(said, found[check]), found[check]


def test_the_command_prints_a_table_and_writes_a_report(tmp_path: Path) -> None:
    file = tmp_path / "report.json"
    options = ["test-client", "--runs", str(tmp_path), "-k", "wire/decode", "-k", "launch/stdin", "--report", str(file)]
    result = CliRunner().invoke(app, [*options, "--", *PROGRAM, "echoes"])
    assert result.exit_code == 1
    assert "✗ wire/decode" in result.output
    assert "→ Compile `proto/` again." in result.output
    assert "1 passed, 1 failed: the client does not do what it should" in result.output
    report = json.loads(file.read_text(encoding="utf-8"))
    assert not report["passed"]
    assert [check["outcome"] for check in report["checks"]] == ["failed", "passed"]


def test_missing_program_is_reported(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["test-client", "--runs", str(tmp_path), "--", "no-such-program"])
    assert result.exit_code != 0
    assert "no-such-program" in str(result.exception)


def test_a_program_that_says_nothing_fails(tmp_path: Path) -> None:
    report = judge([sys.executable, "-c", "pass"], tmp_path, ["launch/heartbeats"])
    assert [result.outcome for result in report.results] == [CheckOutcome.FAILED]
    assert "the step ready; came the end of the program (exit code 0)" in report.results[0].line
