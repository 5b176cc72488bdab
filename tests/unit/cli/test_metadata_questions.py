"""`afspm run --ask`: sample, person, project and probe, asked until they are right."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from afspm.cli.run import ask_metadata
from afspm.experiment import load

FILE = """
[metadata]
sample = "Au(111)"

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
"""


def test_questions_offer_known_values_and_repeat_after_invalid_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "e.toml"
    file.write_text(FILE, encoding="utf-8")
    answers = ["", "A. Student", "0000-0002-1825-0098", "0000-0002-1825-0097", "", "PPP-NCHR 12/7", ""]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
    assert ask_metadata(load(file)) == {
        "sample": "Au(111)",
        "person": "A. Student",
        "orcid": "https://orcid.org/0000-0002-1825-0097",
        "probe": "PPP-NCHR 12/7",
        "technique": "AFM",
    }
    assert "its last digit does not match the others" in capsys.readouterr().out
