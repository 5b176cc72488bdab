"""The driver on Nion's simulated microscope: the conformance suite, settings, and a night whose stage drifts."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nion.device_kit.ScanDevice import ScanFrameParameters

import afspm
import afspm_nion
from afspm.basics import ConfigError
from afspm.model import Region, RegistrationOutcome
from afspm_nion import Nion
from afspm_nion.microscope import frame_parameters

SIMULATED = Path(afspm_nion.__file__).with_name("simulated.toml")
NIGHT = """
[clock]
speed = 120.0

[microscope]
drift = ["20 pm/s", "-12 pm/s"]

[scheduler]
component = true
class = "DriftCompensatedScheduler"
drift = { at_start = "nothing" }

[rescanner]
component = true
class = "Rescanner"

[series]
component = true
class = "ScanSeries"
size = ["200 nm", "200 nm"]
pixels = [96, 96]
parameters = { scan-speed = "4 um/s" }
scans = 6
every = "10 min"
end_when_done = true

[drift_table]
component = true
class = "DriftTable"
file = "drift_table.csv"
"""


def run_afspm(*arguments: object, where: Path) -> str:
    """Run a command of afspm to its end, and return its output."""
    command = [sys.executable, "-m", "afspm", *map(str, arguments)]
    ended = subprocess.run(command, cwd=where, capture_output=True, text=True, timeout=500)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def test_translator_passes_the_suite(tmp_path: Path) -> None:
    output = run_afspm("test-translator", SIMULATED, "--runs", tmp_path / "runs", where=tmp_path)
    assert "✓ scan/picture" in output
    assert "Nion's pixels are square" in output
    assert "the translator passes the suite" in output


def test_drift_of_the_stage_is_followed(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(NIGHT, encoding="utf-8")
    run_afspm("run", SIMULATED, "night.toml", "--runs", tmp_path / "runs", where=tmp_path)
    (folder,) = (file.parent for file in (tmp_path / "runs").glob("simulated-*/run.json"))
    with (folder / "stage.csv").open(newline="", encoding="utf-8") as file:
        stage_m = np.array([[float(row[1]), float(row[2])] for row in csv.reader(file)])
    with (folder / "drift_table.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    drift_m = np.array([[float(row["drift_x_m"]), float(row["drift_y_m"])] for row in rows])
    center_m = np.array([[float(row["center_x_m"]), float(row["center_y_m"])] for row in rows])
    true_m = (stage_m - stage_m[0])[-len(rows) :]
    assert np.hypot(*true_m[-1]) > 50e-9
    # a pixel is 2.1 nm wide; a place also depends on the wait before the scan, half a minute on a busy computer
    assert np.hypot(*(drift_m - true_m).T).max() < 0.7e-9
    assert np.hypot(*(center_m - true_m)[2:].T).max() < 3e-9
    with afspm.open_run(folder) as run:
        assert {scan.registration for scan in run.scans} == {RegistrationOutcome.REGISTERED}
        first = run.scan(run.scans[0])
        assert first["topography"].channel == first["intensity"].channel == "HAADF"
    assert "withdrawn" not in (folder / "report.html").read_text(encoding="utf-8")


def test_frame_that_is_not_square_is_a_part_of_a_square_one() -> None:
    region = Region((10e-9, 20e-9), (62e-9, 30e-9), 0.1)
    parameters = frame_parameters(ScanFrameParameters(), region, (16, 32), 1e-5)
    assert parameters.fov_nm == pytest.approx(64.0)
    assert tuple(parameters.pixel_size) == (32, 32)
    assert tuple(parameters.subscan_pixel_size) == (16, 32)
    assert tuple(parameters.subscan_fractional_size) == (0.5, 1.0)
    assert tuple(parameters.center_nm) == pytest.approx((-20.0, 10.0))
    assert (parameters.rotation_rad, parameters.pixel_time_us) == pytest.approx((-0.1, 10.0))


@pytest.mark.parametrize(("detectors", "words"), [(["HAAFD"], "no detector 'HAAFD'"), ([], "a scan needs a detector")])
def test_detector_that_there_is_not_is_refused(detectors: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Nion(detectors=detectors)
