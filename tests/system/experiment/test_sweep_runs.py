"""A sweep through real processes: the component, the scheduler and the translator killed, and the run resumed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.report import night_report as report

SAMPLE = Path(__file__).parents[3] / "experiments" / "sweep" / "experiment.toml"
FEWER = """
[clock]
speed = 20.0
[sweep]
pixels = [32, 32]
order = "random"
seed = 4
[sweep.parameters]
zctrl-setpoint = [0.6, 0.8]
zctrl-igain = [200, 2000]
scan-speed = { from = "2 um/s", to = "4 um/s", points = 2 }
"""
POINTS = 8


def overlay(folder: Path) -> str:
    file = folder / "fewer.toml"
    file.write_text(FEWER, encoding="utf-8")
    return str(file)


def require_each_once(one: AfspmRun, said: str) -> None:
    """Each combination was measured once, and the parameters are back."""
    with afspm.open_run(one.folder) as record:
        rows = [row for row in record.scans if not row.interrupted]
        keys = Counter(row.key for row in rows if row.key)
        table = record.scans.where(lambda row: not row.interrupted).to_pandas()
        set_last = {entry.what.split(" = ")[0]: entry.what for entry in record.journal if " = " in entry.what}
    assert len(rows) == POINTS, said
    assert set(keys) <= {f"sweep-{number}" for number in range(1, POINTS + 1)}
    assert set(keys.values()) == {1}, said
    combinations = {
        tuple(np.round(values, 12))
        for values in zip(table["zctrl-setpoint [V]"], table["zctrl-igain"], table["scan-speed [m/s]"], strict=True)
    }
    assert len(combinations) == POINTS, table
    assert set_last["zctrl-igain"] == "zctrl-igain = 1500", set_last
    assert set_last["scan-speed"] == "scan-speed = 2 µm/s", set_last


def test_sweep_measures_each_point_once_whichever_process_is_killed(afspm_run: Run, tmp_path: Path) -> None:
    one = afspm_run(str(SAMPLE), overlay(tmp_path), "--runs", str(tmp_path / "runs"))
    one.wait_for("point 1 of 8")
    one.kill("sweep")
    one.wait_for("point 3 of 8")
    one.kill("microscope")
    one.wait_for("point 5 of 8")
    one.kill("scheduler")
    assert one.end() == 0, one.output
    require_each_once(one, one.output)


def test_a_sweep_whose_run_is_killed_is_resumed(afspm_run: Run, tmp_path: Path) -> None:
    first = afspm_run(str(SAMPLE), overlay(tmp_path), "--runs", str(tmp_path / "runs"))
    first.wait_for("point 4 of 8")
    first.process.kill()
    first.process.wait()
    again = afspm_run("--resume", str(first.folder))
    assert again.end() == 0, again.output
    require_each_once(first, again.output)
    page = report.write(first.folder).read_text(encoding="utf-8")
    assert (first.folder / "sweep.png").stat().st_size > 50_000
    assert 'alt="sweep.png"' in page
