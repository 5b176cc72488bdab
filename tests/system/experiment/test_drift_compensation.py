"""Real processes on a drifting sample: components in sample coordinates see it stand still."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from systems import KILLED_FROM_OUTSIDE, PATIENCE, kill
from tests.system.experiment.drift_rig import Rig, Surveyed, surveyed, table, worker_of

from afspm.model import Region

KNOWN_M = 2e-9
"""How well a scan is known to lie; a pixel is 16 nm."""
THIRD_OF_A_PIXEL_M = 5.3e-9
PLACED_M = 20e-9
"""How well one lies where it was asked for, once the rate is known; the sample drifts by 60 nm and more between two."""
QUICK = 120.0
"""Where it does not matter how well that is."""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path)
    yield made
    made.close()


def away_m(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(np.hypot(*(a - b).T))


def require_it_stood_still(found: Surveyed, scans: int) -> None:
    assert len(found.said_m) == len(found.spectra_said_m) == scans
    assert away_m(found.drift_m[-1:], found.drift_m[:1])[0] > 200e-9  # there was something to correct
    assert (away_m(found.said_m, found.true_m) < KNOWN_M).all(), found
    assert (away_m(found.true_m[1:], np.zeros(2)) < PLACED_M).all(), found
    assert (away_m(found.spectra_said_m, found.spectra_true_m)[1:] < 10e-9).all(), found
    assert (away_m(found.spectra_true_m[2:], np.array([0.2e-6, 0.1e-6])) < PLACED_M).all(), found


def test_components_see_a_drifting_sample_stand_still(rig: Rig) -> None:
    run = rig.start('rescan = { rule = "never" }', scans=5)
    assert run.end() == 0, run.output
    require_it_stood_still(surveyed(run), 5)
    rows = table(run)
    assert [row["matched"] for row in rows] == ["yes"] * 6, rows  # the first one in both directions
    assert len({row["filename"] for row in rows}) == 6
    rate = [float(rows[-1][f"rate_{axis}"]) for axis in "xy"]
    np.testing.assert_allclose(rate, [0.25e-9, -0.15e-9], atol=0.02e-9)


def test_scheduler_and_worker_keep_the_drift_mapping_over_a_kill(rig: Rig) -> None:
    run = rig.start('rescan = { rule = "never" }', scans=5)
    run.wait_for("surveyor .*round 1 is done")
    kill(worker_of(run))
    run.wait_for("surveyor .*round 2 is done")
    run.kill("scheduler")
    assert run.end() == 0, run.output
    assert f"is restarted: exit code {KILLED_FROM_OUTSIDE}" in run.output
    require_it_stood_still(surveyed(run), 5)
    rows = table(run)
    assert [row["matched"] for row in rows] == ["yes"] * len(rows), rows
    assert len({row["filename"] for row in rows}) == len(rows)  # no scan was published twice


def test_drift_is_visible_without_correction(rig: Rig) -> None:
    run = rig.start("correct = false", scans=3, speed=QUICK)
    assert run.end() == 0, run.output
    found = surveyed(run)
    np.testing.assert_array_equal(found.said_m, np.zeros((3, 2)))
    rows = table(run)
    told = np.array([[float(row["drift_x_m"]), float(row["drift_y_m"])] for row in rows])
    assert (away_m(told, found.drift_m) < KNOWN_M).all(), (told, found.drift_m)
    assert {row["correcting"] for row in rows} == {"no"}


def test_first_scans_up_and_down_give_the_drift_velocity(rig: Rig) -> None:
    run = rig.start('rescan = { rule = "never" }', scans=3)
    assert run.end() == 0, run.output
    run.wait_for("rescanner is in control to solve thermal-drift")
    run.wait_for("rescanner cleared thermal-drift")
    found = surveyed(run)
    assert (away_m(found.said_m, found.true_m) < KNOWN_M).all(), found
    assert (away_m(found.true_m[1:], np.zeros(2)) < PLACED_M).all(), found  # without it the first is 60 nm off
    assert len(table(run)) == 4


def test_scan_with_too_large_an_offset_is_repeated(rig: Rig) -> None:
    run = rig.start('at_start = "nothing", rescan = { tolerance = "40 nm" }', scans=2)
    assert run.end() == 0, run.output
    run.wait_for("rescanner .*the same region again: it may be .* nm off")
    run.wait_for("rescanner cleared thermal-drift")
    found, rows = surveyed(run), table(run)
    assert away_m(found.true_m[1:], np.zeros(2))[0] > 40e-9
    assert len(rows) == 3
    misplaced = [[float(rows[2][f"{what}_{axis}_m"]) for axis in "xy"] for what in ("center", "drift")]
    assert away_m(*np.array(misplaced)[:, None])[0] < PLACED_M


def test_controller_with_the_drift_rate_compensates_by_itself(rig: Rig) -> None:
    rates = 'compensate = { x = "x-drift-rate-x", y = "x-drift-rate-y" }'
    run = rig.start(f'{rates}, rescan = {{ rule = "never" }}', scans=6)
    assert run.end() == 0, run.output
    found = surveyed(run)
    assert (away_m(found.said_m, found.true_m) < KNOWN_M).all(), found
    # a scan that has begun before the rate was handed over has it handed over after it
    assert (away_m(found.true_m[3:], np.zeros(2)) < PLACED_M).all(), found
    # 60 nm and more without it; on a busy computer the rate is known only some scans after the first
    assert (away_m(found.drift_m[5:], found.drift_m[4:5]) < 10e-9).all(), found


def test_failing_or_hanging_user_estimator_loses_no_scan(rig: Rig) -> None:
    # long enough for a busy computer to start a worker, and short enough on the sample to go on as predicted
    options = (
        'estimator = "surveyor.Fails", longest_registration = "9 s", rescan = { rule = "never" }, at_start = "nothing"'
    )
    run = rig.start(options, scans=5, speed=40.0)
    assert run.end() == 0, run.output
    run.wait_for("scheduler .*is published at the predicted position .*: it was not registered within 9 s")
    rows = table(run)
    outcomes = [row["outcome"] for row in rows]
    assert outcomes == ["registered", "coarse", "failed", "registered", "registered"], rows  # the third hangs
    assert "ZeroDivisionError: nothing is known" in rows[1]["reason"]
    assert rows[1]["failures"] == "1"
    assert "ZeroDivisionError: nothing is known: an error of the estimator" in run.output
    found = surveyed(run)
    assert len(found.said_m) == 5
    assert (away_m(found.said_m, found.true_m)[[0, 3, 4]] < KNOWN_M).all(), found


@pytest.mark.parametrize("transform", ["translation", "similarity"])
def test_similarity_keeps_corners_in_place_on_a_rotating_and_expanding_sample(rig: Rig, transform: str) -> None:
    """It rotates about a place two frames away. The placing of a frame lags by one interval; the mapping does not."""
    tracker = f'{{ class = "bank", transform = "{transform}", compared = 2 }}'
    sample = "rotation_rad_per_s = 1.8e-6, expansion_per_s = 0.7e-6, about_m = [-1.6e-6, -1.2e-6]"
    options = f'tracker = {tracker}, rescan = {{ rule = "never" }}'
    # a slow computer would let the sample turn far while the first worker starts
    run = rig.start(options, scans=7, speed=1200.0 / PATIENCE, sample=sample, pause_s=1200.0)
    assert run.end() == 0, run.output
    found = surveyed(run)
    assert away_m(found.drift_m[-1:], found.drift_m[:1])[0] > 20e-9
    assert (away_m(found.said_m, found.true_m) < KNOWN_M).all(), found  # the centres, either way
    wanted_m = Region((0.0, 0.0), (1e-6, 1e-6)).corners_m()
    mistaken_m = away_m(found.corners_said_m, found.corners_true_m).T.max(axis=1)
    misplaced_m = away_m(found.corners_true_m, wanted_m).T.max(axis=1)
    if transform == "similarity":
        # mostly 0.2 nm, and 3 nm on a busy computer, where the sample turns farther between two scans
        assert (mistaken_m < THIRD_OF_A_PIXEL_M).all(), mistaken_m
        assert (misplaced_m[2:] < 2 * THIRD_OF_A_PIXEL_M).all(), misplaced_m
        # till then nothing is known
        assert (away_m(found.spectra_said_m, found.spectra_true_m)[1:] < THIRD_OF_A_PIXEL_M).all(), found
    else:
        assert mistaken_m[-1] > 8e-9, mistaken_m
        assert misplaced_m[-1] > 8e-9, misplaced_m
