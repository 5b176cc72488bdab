"""Every sample runs unchanged to its end; here with fewer pixels and scans.

The samples of tip repair and of makers' controllers run in other tests.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.supervisor.ports import FreePorts

EXPERIMENTS = Path(__file__).parents[3] / "experiments"
SERIES = '[series]\nscans = 2\nevery = "2 min"\npixels = [16, 16]\n'
QUICKER: dict[str, tuple[str, int, int]] = {
    "keep_scanning": ('[series]\nduration = "15 min"\npixels = [16, 16]\n', 1, 0),
    "scan_list": ('[list]\nevery = "5 min"\npixels = [16, 8]\n', 6, 0),
    "sweep": ("[sweep]\npixels = [16, 16]\n[sweep.parameters]\nscan-speed = [8e-6]\n", 9, 0),
    "agent": ("", 1, 1),
    "region_grid": ("[grid]\ncounts = [2, 2]\npixels = [16, 16]\n", 4, 0),
    "adaptive_map": ("[map.until]\nspectra = 12\n", 0, 12),
    "spectroscopy_grid": ("[curves]\ncounts = [2, 2]\n", 0, 4),
    "line_watch": ("[series]\nscans = 2\npixels = [16, 16]\n", 2, 0),
    "picture": ("[clock]\nspeed = 600.0\n[details]\npixels = [16, 12]\n", 3, 0),
    "own_component": (SERIES, 2, 0),
    "other_language": ("[flattest]\npixels = 32\n", 2, 0),
    "two_computers": (SERIES, 2, 0),
    "wide_and_narrow": ("[list]\nrounds = 1\npixels = [16, 16]\n", 4, 0),
    "feedback_gains": ('[series]\nduration = "90 min"\npixels = [32, 32]\n', 4, 0),
    "best_points": ("[best_points]\nrounds = 1\nbest = 2\npixels = 32\n[random_points]\npoints = 5\n", 3, 0),
    "time_lapse": ("[series]\nscans = 3\npixels = [64, 64]\n", 4, 0),  # one of them by the Rescanner
    "particle_survey": ("[survey]\ncount = 2\n", 4, 4),  # one of them by the Rescanner
    "paper_form": ('scan_pixels = [16, 16]\n[series]\nduration = "10 min"\n', 1, 0),
}
"""What is other than in the sample, and how many scans and spectra come of it."""
FOR_A_TIME = {"feedback_gains", "keep_scanning", "paper_form"}  # and as many more as a busy computer finds time for
ADDRESS = re.compile(r'^(\w+) = "tcp://127\.0\.0\.1:\d+"$', re.MULTILINE)
SAYS = {
    "feedback_gains": (
        "is too slow",
        "tuner +integral gain 1280: the feedback follows",
        "oscillates",
        "integral gain 3125$",
    )
}
"""What the log has to say, in this order."""


def to_its_end(afspm_run: Run, tmp_path: Path, files: tuple[str, ...], quicker: str, *options: str) -> AfspmRun:
    """Run a reduced sample at free ports; it ends without an error."""
    samples, second, ports = [EXPERIMENTS / file for file in files], tmp_path / "quicker.toml", FreePorts()
    used = ADDRESS.findall(samples[0].read_text(encoding="utf-8"))
    second.write_text("".join(f'{use} = "{ports.address()}"\n' for use in used) + quicker, encoding="utf-8")
    one = afspm_run(*map(str, samples), str(second), "--runs", str(tmp_path / "runs"), *options)
    assert one.end() == 0, one.output
    assert not [line for line in one.lines if re.search(r" (ERROR|CRITICAL) ", line)], one.output
    return one


@pytest.mark.parametrize("name", QUICKER)
def test_a_sample_runs_to_its_end(afspm_run: Run, tmp_path: Path, name: str) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("PIL")
    quicker, scans, spectra = QUICKER[name]
    one = to_its_end(afspm_run, tmp_path, (f"{name}/experiment.toml",), quicker)
    assert re.search(".*".join(SAYS.get(name, ())), one.output, re.DOTALL | re.MULTILINE), one.output
    with afspm.open_run(one.folder) as record:
        taken = min(len(record.scans), scans) if name in FOR_A_TIME else len(record.scans)
        assert (taken, len(record.spectra)) == (scans, spectra), one.output


# at 240 times real time a busy computer takes scans late
SHORT_NIGHT = """
[clock]
speed = 120.0
[series]
every = "5 min"
scans = 7
pixels = [64, 64]
[scheduler.drift]
correct_after = "15 min"
"""
NIGHT = "drift_night/experiment.toml"
TABLE = '[drift_table]\ncomponent = true\nclass = "DriftTable"\n'
SHORT_SERIES = '[experiment]\nevery = "6 min"\nscans = 7\n'


# The paper's method extrapolates by the difference of two estimates, each half a pixel uncertain: on an idle computer
# the frame was up to 1.5 pixels off in one night of three. Without any correction it would be 5 pixels off
@pytest.mark.parametrize(
    ("files", "quicker", "pixels"),
    [
        ((NIGHT, "drift_night/simulator.toml"), SHORT_NIGHT + TABLE, 1.0),
        ((NIGHT, "drift_night/simulator.toml", "drift_night/paper.toml"), SHORT_NIGHT + TABLE, 2.0),
        (("paper_form/drift.toml",), SHORT_SERIES + TABLE, 1.0),
    ],
    ids=["drift_night", "drift_night-paper", "published"],
)
def test_drift_night_runs_and_its_frame_follows_the_sample(
    afspm_run: Run, tmp_path: Path, files: tuple[str, ...], quicker: str, pixels: float
) -> None:
    if "drift_night/paper.toml" in files:
        pytest.importorskip("skimage")
    pictures = ("--without", "drift_pictures") if "drift_night" in files[0] else ()  # they take longer than the night
    one = to_its_end(afspm_run, tmp_path, files, quicker, *pictures)
    with (one.folder / "drift_correction.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 7, one.output
    assert [row["reason"] for row in rows if row["matched"] != "yes"] == []
    assert {row["correcting"] for row in rows[-3:]} == {"yes"}
    drift_m, center_m = (
        np.array([[float(row[f"{what}_{axis}_m"]) for axis in "xy"] for row in rows[-3:]])
        for what in ("drift", "center")
    )
    pixel_m = 2e-6 / 64
    assert np.hypot(*drift_m[-1]) > 3 * pixel_m, "the sample stood still"
    off_m = np.hypot(*(center_m - drift_m).T)  # at a time more, where a busy computer has left scans out
    assert np.median(off_m) < pixels * pixel_m, "the frame is not where the sample has gone"
