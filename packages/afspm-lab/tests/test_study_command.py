"""`afspm drift study`, from the command line to the table."""

from __future__ import annotations

from typer.testing import CliRunner

from afspm.cli.app import app

SMALL = ["surface=particles", "pixels=32", "size_m=5e-7", "hours=1", "estimator=correlation"]


def told(*arguments: str, code: int = 0) -> str:
    done = CliRunner().invoke(app, ["drift", "study", *arguments], env={"COLUMNS": "200"}, catch_exceptions=True)
    assert done.exit_code == code, done.output
    return done.output


def test_a_study_names_the_best_and_judges_the_defaults() -> None:
    output = told(*SMALL, "tracker=bank,paper", "-n", "2", "-j", "1")
    assert "tracker=paper" in output
    assert "best" in output
    assert "The defaults" in output


def test_failing_settings_are_reported_and_the_others_go_on() -> None:
    output = told(*SMALL, "tracker=bank,paper", "paper.queue=0", "-n", "2", "-j", "1")
    assert "tracker=paper: 2 nights failed" in output
    assert "The defaults are the best." in output
