"""The hook that looks at the first line of a commit."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "commit_subject.py"


def checked(tmp_path: Path, message: str) -> subprocess.CompletedProcess[str]:
    file = tmp_path / "message"
    file.write_text(message, encoding="utf-8")
    return subprocess.run([sys.executable, TOOL, file], capture_output=True, text=True)


@pytest.mark.parametrize(
    "subject", ["translator: subscribe before connecting", "docs, tests: mend links", "Merge branch"]
)
def test_commit_with_an_area_passes(subject: str, tmp_path: Path) -> None:
    assert checked(tmp_path, f"{subject}\n\nThe reason.\n").returncode == 0


@pytest.mark.parametrize(
    ("message", "problem"),
    [
        ("Mend the links\n", "is not of the form"),
        ("docs: mend the links.\n", "without a full stop"),
        ("docs: " + "x" * 67 + "\n", "has 73 characters"),
        ("# only comments\n", "is not of the form"),
    ],
)
def test_commit_without_the_form_is_refused(message: str, problem: str, tmp_path: Path) -> None:
    refused = checked(tmp_path, message)
    assert refused.returncode == 1
    assert problem in refused.stderr
