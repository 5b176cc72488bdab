"""The paper's sample of control transfer, with one change of the tip, through real processes."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from datetime import UTC
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from systems import PATIENCE

from afspm.basics.formatting import day_and_time
from afspm.model import Problem
from afspm.night.night_record import NightRecord
from afspm.night.run import open_run

SAMPLE = Path(__file__).parents[3] / "experiments" / "tip_repair" / "experiment.toml"
SHORTER = """
[microscope]
tip_changes = { schedule = [[2700, "double"]], pulse_cures = 0.6 }

[series]
duration = "90 min"
retakes = 2
"""
TAKEN = re.compile(r"scan \d+ of \d+(?: again)? at (\S+ \S+) UTC")
"""What the series says of each scan; on a busy computer one may be due before the one before is done."""

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.timeout(DEADLINE_S + 70)


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that has ended by itself."""
    folder = tmp_path_factory.mktemp("night")
    (folder / "shorter.toml").write_text(SHORTER, encoding="utf-8")
    command = [sys.executable, "-m", "afspm", "run", str(SAMPLE), "shorter.toml", "--speed", f"{300 / PATIENCE:g}"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, timeout=DEADLINE_S, encoding="utf-8", check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    (run,) = (folder / "runs").glob("tip_repair-*")  # some systems have no links
    return run


def record_of(night: Path) -> NightRecord:
    (file,) = (night / "state").glob("*.night.jsonl")
    return NightRecord.from_lines(file.read_text(encoding="utf-8").splitlines())


def test_corrector_gets_control_and_returns_it(night: Path) -> None:
    record = record_of(night)
    (flagged,) = record.problem_spans(Problem.TIP_SHAPE_CHANGED)
    (repair,) = record.control_spans("tip_corrector")
    before, *_, after = record.control_spans("series")
    assert before.end_ns is not None
    assert flagged.end_ns is not None
    assert before.end_ns <= flagged.start_ns <= repair.start_ns
    # clearing the flag takes control from the component that solved the problem
    assert repair.end_ns == flagged.end_ns
    assert flagged.end_ns <= after.start_ns
    assert record.problems == [Problem.TIP_SHAPE_CHANGED]


def test_flag_is_set_at_the_tip_change_and_cleared_by_the_repair(night: Path) -> None:
    truth = [json.loads(line) for line in (night / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    start_s = truth[0]["time_s"]
    cures = [e["time_s"] for e in truth if e.get("outcome") == "cured"]
    (flagged,) = record_of(night).problem_spans(Problem.TIP_SHAPE_CHANGED)
    assert flagged.end_ns is not None
    assert 2700.0 < flagged.start_ns / 1e9 - start_s < 2700.0 + 1500.0
    assert cures
    assert 0.0 < flagged.end_ns / 1e9 - cures[-1] < 1500.0


def test_each_requested_scan_is_in_the_table_once(night: Path) -> None:
    with (night / "metadata.csv").open(newline="", encoding="utf-8") as file:
        heights = [row for row in csv.DictReader(file) if row["channel"] == "Height"]
    said = TAKEN.findall((night / "log.txt").read_text(encoding="utf-8"))
    assert len(said) > 5
    assert [row["time"][:19].replace("T", " ") for row in heights if row["in_control"] == "series"] == said
    tests = [row for row in heights if row["in_control"] == "tip_corrector"]
    assert tests
    assert {row["problems"] for row in tests} == {"tip-shape-changed"}
    assert all(Path(row["filename"]).exists() for row in heights)


def test_scan_with_the_bad_tip_is_taken_again_after_the_repair(night: Path) -> None:
    log = (night / "log.txt").read_text(encoding="utf-8")
    bad, *_ = re.findall(r"scan (\d+) showed a bad tip, and is taken again", log)
    (first,) = re.findall(rf"scan {bad} of \d+ at (\S+ \S+) UTC", log)
    *_, again = re.findall(rf"scan {bad} of \d+ again at (\S+ \S+) UTC", log)  # the second one is flagged
    with open_run(night) as run:
        verdicts = {day_and_time(time_ns, UTC): score for time_ns, score in run.verdicts()}
    assert (verdicts[f"{first} UTC"], verdicts[f"{again} UTC"]) == (0.0, 1.0)


def test_ledger_of_the_record_equals_the_truth(night: Path) -> None:
    truth = [json.loads(line) for line in (night / "truth.jsonl").read_text(encoding="utf-8").splitlines()]
    pulses = [one for one in truth if one["event"] == "pulse"]
    crashes = [one for one in truth if one["event"] == "crash"]
    with open_run(night) as run:
        ledger = run.ledger()
    assert ledger.treatments
    assert (ledger.pulses, ledger.crashes, ledger.unknown) == (len(pulses), len(crashes), 0)
    assert ledger.pulse_v_s == pytest.approx(sum(abs(one["voltage_v"]) * one["duration_s"] for one in pulses))
    assert ledger.crash_depth_m == pytest.approx(sum(one["depth_m"] for one in crashes))
    assert ledger.by == {"tip_corrector": ledger.treatments}
    assert f"<td>tip_corrector {ledger.treatments}</td>" in (night / "report.html").read_text(encoding="utf-8")


def test_the_night_is_drawn(night: Path) -> None:
    assert (night / "night.png").read_bytes().startswith(b"\x89PNG")
