"""The scheduler with sample coordinates, replayed: its worker's results are inputs from the record."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.plugins.drift.frame import scan_intake
from afspm.plugins.drift.frame.worker import DriftWorkerInProcess
from afspm.storage.line_log import read_lines
from afspm.testing import Bench
from afspm_lab.what_if.scheduler_replay import replay_file

NIGHT = """
[record]
requests = true
[microscope]
component = true
class = "Simulator"
surface = { kind = "particles" }
drift = { velocity_m_per_s = [40e-12, -20e-12, 0.0] }
initial = { scan-speed = "4 um/s" }
[scheduler]
component = true
class = "DriftCompensatedScheduler"
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "10 min"
scans = 3
[rescanner]
component = true
class = "Rescanner"
"""


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The step log of a scheduler that was killed after its first scan."""
    folder = tmp_path_factory.mktemp("drift")
    file = folder / "night.toml"
    file.write_text(NIGHT, encoding="utf-8")
    bench = Bench.of(file, component="series", folder=folder)
    bench.at("8 min", bench.kill, "scheduler")
    bench.run(until="35 min")
    return folder / "requests" / "scheduler.steps.jsonl"


def test_unchanged_drift_scheduler_repeats_its_record_without_a_worker(
    steps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(DriftWorkerInProcess, "take", None)  # any job would fail
    reports = [event for kind, event, *_ in read_lines(steps) if kind == "step" and event and "Registered" in event]
    assert len(reports) >= 3
    result = replay_file(steps)
    assert (result.first, result.first_step, result.stopped) == (None, None, "")
    assert result.steps > 200
    assert "worker are the recorded ones" in result.note


def test_scan_published_at_another_place_is_a_difference(steps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan is larger than the packets kept whole: its place must be compared all the same."""
    monkeypatch.setattr(scan_intake, "_relocated", lambda event, *_: event)
    first = replay_file(steps).first
    assert first is not None
    assert first.now is not None
    assert (first.now.message, first.now.key.partition("_")[0]) == ("Publish", "Scan2d")


def test_changed_drift_settings_are_a_difference(steps: Path) -> None:
    first = replay_file(steps, {"drift": {"correct": False}}).first
    assert first is not None
