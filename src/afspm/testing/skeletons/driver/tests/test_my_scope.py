from __future__ import annotations

from pathlib import Path

from afspm.testing.translators import CheckOptions, run

EXPERIMENT = Path(__file__).parents[1] / "experiment.toml"


def test_it_does_what_a_translator_should(tmp_path: Path) -> None:
    report = run(CheckOptions([EXPERIMENT], runs=tmp_path))
    assert not report.failed
    assert report.passed, report
