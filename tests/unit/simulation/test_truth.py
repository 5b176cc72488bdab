"""The ground truth of a simulated microscope, and a disk that refuses to write."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest

from afspm.simulation.truth import Truth


def test_disk_that_refuses_the_truth_refuses_no_measurement(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = tmp_path / "run"
    folder.write_text("a file where the folder should be", encoding="utf-8")
    truth = Truth(folder / "truth.jsonl")
    with caplog.at_level(logging.INFO, "afspm"):
        for number in range(2):
            truth.note(float(number), "scan starts", {})
        folder.unlink()
        truth.note(2.0, "scan starts", {})
    assert [record.levelname for record in caplog.records] == ["CRITICAL", "INFO"]
    (line,) = (folder / "truth.jsonl").read_text(encoding="utf-8").splitlines()
    assert json.loads(line)["n"] == 3, "the number shows that two events are missing"


def test_line_after_a_part_of_a_line_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "truth.jsonl"
    file.write_text('{"n": 1, "time', encoding="utf-8")
    for number in range(2):
        Truth(file, {"truth_lines": number + 1}).note(0.0, "scan starts", {})
    part, *lines = file.read_text(encoding="utf-8").splitlines()
    assert part == '{"n": 1, "time'
    assert [json.loads(line)["n"] for line in lines] == [2, 3]
