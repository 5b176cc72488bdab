"""A component that freezes in its block each time: the others measure all the same."""

from __future__ import annotations

from pathlib import Path

from tests.system.experiment.experiment_lab import AfspmRun

STUCK = """
import threading

from afspm import Component


class Stuck(Component):
    longest_step_s = 1.0

    def run(self):
        with self.scope.control():
            self.log.info("in its block")
            threading.Event().wait()
"""
EXPERIMENT = """
[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"

[stuck]
component = true
class = "stuck.Stuck"

[restart]
beat_period = 0.25
missed_beats = 40
"""
SERIES = """
[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [16, 16]
every = "1 s"
scans = 1
"""


def test_component_that_freezes_in_its_block_each_time_lets_a_series_scan(tmp_path: Path) -> None:
    (tmp_path / "stuck.py").write_text(STUCK, encoding="utf-8")
    first, later = tmp_path / "experiment.toml", tmp_path / "later.toml"
    first.write_text(EXPERIMENT, encoding="utf-8")
    later.write_text(SERIES, encoding="utf-8")
    run = AfspmRun("run", str(first), str(later), "--runs", str(tmp_path / "runs"), "--no-report", folder=tmp_path)
    try:
        run.wait_for("stuck was restarted 3 times without giving control back, and loses it")
        run.wait_for("series .*scan 1 of 1")
    finally:
        run.close()
