"""The checks of translators, on a translator that was made without afspm."""

from __future__ import annotations

from pathlib import Path

from afspm.testing.translators import CheckOptions, CheckOutcome, run

PLAIN = """
[microscope]
component = true
class = "SimulatedPublishedTranslator"
program = ["python", "{script}"]
"""


def test_translator_of_version_1_made_without_afspm_is_checked_just_the_same(tmp_path: Path) -> None:
    file = tmp_path / "experiment.toml"
    file.write_text(PLAIN.format(script=Path(__file__).with_name("plain.py").as_posix()), encoding="utf-8")
    report = run(CheckOptions([file], runs=tmp_path / "runs"))
    assert report.passed, report
    passed = {result.name for result in report.results if result.outcome is CheckOutcome.PASSED}
    assert {
        "scan/cancel",
        "scan/order",
        "scan/frame",
        "scan/time",
        "frame/set",
        "refused/nan",
        "busy/refused",
    } <= passed
    assert report.support.actions["start-scan"] is None  # it can't be asked what it supports
    assert report.support.parameters["tip-bias-voltage"] is None
