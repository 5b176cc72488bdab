"""A survey of particles through real processes: killed, resumed, delayed by a problem, on a drifting sample."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest
from tests.system.experiment.experiment_lab import AfspmRun, Run

import afspm
from afspm.basics.errors import ExperimentEnded
from afspm.components.surveying import find_particles, nearest

pytest.importorskip("skimage")
ROOT = Path(__file__).parents[3]
SAMPLE = ROOT / "experiments" / "particle_survey" / "experiment.toml"
TUTORIAL = ROOT / "docs" / "tutorials" / "particle-survey.md"
FEWER = """
[survey]
count = 4
zoom_pixels = [64, 64]
"""
# a restart must not take so much simulated time that the sample drifts away
SLOWER = "[clock]\nspeed = 100.0\n[microscope]\ndrift = { velocity_m_per_s = [5e-12, -3e-12, 0.0] }\n"
BY_HAND = '[control]\nsolved_by_hand = ["tip-shape-changed", "device-malfunction"]\n'
FAST_DRIFT = "[microscope]\ndrift = { velocity_m_per_s = [150e-12, -100e-12, 0.0] }\n"


def overlay(folder: Path, text: str) -> str:
    file = folder / "fewer.toml"
    file.write_text(text, encoding="utf-8")
    return str(file)


def outcomes(folder: Path) -> list[str]:
    with (folder / "targets.csv").open(encoding="utf-8", newline="") as file:
        return [row["outcome"] for row in csv.DictReader(file)]


def require_each_once(one: AfspmRun, targets: int, said: str = "") -> None:
    """Require the survey, each zoom and each curve once, the table and the picture."""
    with afspm.open_run(one.folder) as record:
        scans = [row for row in record.scans if not row.interrupted and row.holder != "rescanner"]
        spectra = list(record.spectra)
    numbers = range(1, targets + 1)
    wanted = ["survey", *(f"zoom-{number}" for number in numbers)]
    wanted += [f"curve-{name}-{number}" for name in ("top", "beside") for number in numbers]
    assert (len(scans), len(spectra)) == (1 + targets, 2 * targets), said or one.output
    # the key of the last one before a kill may be lost
    keys = Counter([row.key for row in scans if row.key] + [row.key for row in spectra if row.key])
    assert set(keys) <= set(wanted)
    assert set(keys.values()) == {1}, one.output
    assert outcomes(one.folder) == ["measured"] * targets
    assert (one.folder / "targets.png").stat().st_size > 50_000


def test_survey_measures_each_target_once_over_kills_and_tip_repairs(afspm_run: Run, tmp_path: Path) -> None:
    one = afspm_run(str(SAMPLE), overlay(tmp_path, FEWER + SLOWER + BY_HAND), "--runs", str(tmp_path / "runs"))
    one.wait_up("scheduler", 1)
    with afspm.connect(one.folder, name="person") as scope:  # joined before: a target takes seconds
        one.wait_for("survey .*4 targets found")
        one.kill("survey")
        one.wait_for("target 1 of 4 .*measured")
        scope.flag("tip-shape-changed")
        one.wait_for("survey .*waiting for control")
        one.kill("survey")
        one.wait_up("survey", 3)
        scope.clear("tip-shape-changed")
        one.wait_for("target 2 of 4 .*measured")
        one.kill("survey")
    assert one.end() == 0, one.output
    require_each_once(one, 4)


def test_resumed_survey_measures_only_the_remaining_targets(afspm_run: Run, tmp_path: Path) -> None:
    first = afspm_run(str(SAMPLE), overlay(tmp_path, FEWER + SLOWER), "--runs", str(tmp_path / "runs"))
    first.wait_for("target 2 of 4 .*measured")
    first.process.kill()
    first.process.wait()
    again = afspm_run("--resume", str(first.folder))
    assert again.end() == 0, again.output
    require_each_once(first, 4, again.output)


def test_targets_stay_in_the_middle_of_their_zooms_while_the_sample_drifts(afspm_run: Run, tmp_path: Path) -> None:
    one = afspm_run(str(SAMPLE), overlay(tmp_path, FEWER + FAST_DRIFT), "--runs", str(tmp_path / "runs"))
    assert one.end() == 0, one.output
    off_m = []
    with afspm.open_run(one.folder) as record:
        drift = record.drift[-1]
        for number in range(1, 5):
            zoom = record.scan(f"zoom-{number}")["Height"]
            found = find_particles(zoom, min_height=50e-9, separation_m=250e-9, widest_m=5e-6)
            target = nearest(found, zoom.region.center_m, 250e-9)
            assert target is not None, f"target {number} is not in its zoom\n{one.output}"
            off_m.append(math.dist(target.position_m, zoom.region.center_m))
    assert math.hypot(*drift.translation_m) > 30e-9, "the sample stood still"
    assert max(off_m) < 40e-9, off_m
    assert not re.search(" ERROR ", one.output), one.output


def test_tutorial_script_does_the_same_in_under_thirty_lines(afspm_run: Run, tmp_path: Path) -> None:
    (script,) = re.findall(r"```python\n(# by_hand.py\n.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    assert script.count("\n") < 30
    (tmp_path / "by_hand.py").write_text(script.replace("(wide, 10,", "(wide, 2,"), encoding="utf-8")
    one = afspm_run(str(SAMPLE), overlay(tmp_path, SLOWER), "--without", "survey", "--runs", str(tmp_path / "runs"))
    one.wait_up("microscope", 1)
    one.wait_up("scheduler", 1)
    done = subprocess.run(
        [sys.executable, "by_hand.py"], cwd=tmp_path, capture_output=True, encoding="utf-8", check=False
    )
    assert done.returncode == 0, done.stderr + one.output
    assert one.end() == 0, one.output
    assert outcomes(tmp_path) == ["measured"] * 2
    assert (tmp_path / "targets.png").stat().st_size > 50_000
    with afspm.open_run(one.folder) as record:
        own = [row.key for row in record.scans if row.holder != "rescanner"]
        assert own == ["survey", "zoom-1", "zoom-2"]


def test_zooms_outside_limits_are_refused_in_the_table_and_an_early_end_leaves_table_and_picture(
    afspm_run: Run, tmp_path: Path
) -> None:
    narrow = '[limits]\nregion = { x = ["-2.5 um", "2.5 um"], y = ["-2.5 um", "2.5 um"] }\n'
    more = FEWER.replace("count = 4", "count = 10")  # enough are left when the end is asked for
    one = afspm_run(str(SAMPLE), overlay(tmp_path, more + SLOWER + narrow), "--runs", str(tmp_path / "runs"))
    one.wait_for("WARNING target 2 of 10 .*refused: zoom: .*lies outside the region allowed")
    with afspm.connect(one.folder, name="person") as scope:
        scope.end_experiment()
    assert one.end() == 0, one.output
    assert outcomes(one.folder)[:2] == ["measured", "refused"]
    assert outcomes(one.folder)[-1] == "not-reached"
    assert (one.folder / "targets.png").stat().st_size > 50_000


def test_survey_with_a_bad_tip_ends_with_its_results_so_far(afspm_run: Run, tmp_path: Path) -> None:
    ends = '[control]\nend_on = ["tip-shape-changed"]\n'
    one = afspm_run(str(SAMPLE), overlay(tmp_path, FEWER + SLOWER + ends), "--runs", str(tmp_path / "runs"))
    one.wait_up("scheduler", 1)
    with suppress(ExperimentEnded), afspm.connect(one.folder, name="classifier") as scope:
        one.wait_for("target 2 of 4 .*measured")
        scope.flag("tip-shape-changed")
    assert one.end() == 0, one.output
    assert outcomes(one.folder)[:2] == ["measured", "measured"]
    assert outcomes(one.folder)[3] == "not-reached"
    assert (one.folder / "targets.png").stat().st_size > 50_000
