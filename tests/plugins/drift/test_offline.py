"""The displacement of a pair of scans over the time in between, and the figures of a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.plugins.drift.test_record import record

from afspm.model import Region
from afspm.plugins.drift.registration import DriftScan, Registration
from afspm.plugins.drift.track.offline import against_first, spread_pairs

REGION = Region((1e-6, 0.0), (2e-6, 1e-6))


def found(displacement_m: tuple[float, float], *, center_m: tuple[float, float] = REGION.center_m) -> Registration:
    return Registration(
        accepted=True,
        reason="",
        displacement_m=np.array(displacement_m),
        covariance_m2=1e-18 * np.eye(2),
        linear=np.zeros((2, 2)),
        center_m=np.array(center_m),
    )


def test_a_pair_holds_for_the_shared_rows_and_is_moved_to_the_middle_of_both_scans() -> None:
    """Sample and rows move up: rows d above the middle are taken late, and meanwhile the sample goes on."""
    scans = [DriftScan(np.zeros((8, 8)), REGION, 900.0 * k, 900.0 * k + 200.0, upwards=True) for k in range(2)]
    rates = np.array([(1e-10, 0.0), (0.0, 2e-10)])
    run = replace(record()[:2], rate_m_s=rates)
    center = (1e-6, 0.25e-6)  # a quarter of the height above the middle: 50 s late in the first scan
    pair = found((10e-9, 100e-9), center_m=center)
    late_s = 50.0 + 0.1 * 200.0
    expected = np.array([10e-9, 100e-9]) - (rates[1] * late_s - rates[0] * 50.0)
    brought = against_first(run, scans, [pair])
    np.testing.assert_allclose(brought.drift_m[1], expected)
    np.testing.assert_allclose(brought.drift_m[0], 0.0)
    assert brought.matched.all()
    unknown = [replace(one, upwards=None) for one in scans]
    np.testing.assert_allclose(against_first(run, unknown, [pair]).drift_m[1], pair.displacement_m)


def test_the_first_scan_of_a_run_has_the_rate_of_the_second() -> None:
    scans = [DriftScan(np.zeros((8, 8)), REGION, 900.0 * k, 900.0 * k + 200.0, upwards=True) for k in range(2)]
    velocity = np.array([1e-10, 2e-10])
    run = replace(record()[:2], rate_m_s=np.array([(0.0, 0.0), velocity]))
    # what lies a quarter of the height above the middle, and is found further up by the drift
    between_s = 900.0 / (1.0 - velocity[1] * 200.0 / REGION.size_m[1])
    pair = found(tuple(velocity * between_s), center_m=(1e-6, 0.25e-6))
    np.testing.assert_allclose(against_first(run, scans, [pair]).drift_m[1], velocity * 900.0)


def test_a_refused_pair_stays_in_the_table_with_its_reason() -> None:
    scans = [DriftScan(np.zeros((8, 8)), REGION, 900.0 * k, 900.0 * k) for k in range(2)]
    refused = against_first(record()[:2], scans, [Registration.refused("nothing in common")])
    assert refused.matched.tolist() == [True, False]
    assert refused.reasons == ("", "nothing in common")
    assert np.isnan(refused.drift_m[1]).all()


def test_drawn_pairs_have_the_given_time_apart_and_are_spread_over_the_run() -> None:
    run = record(20)
    pairs = spread_pairs(run, 7200.0, 2)
    assert len(pairs) == 2
    assert all(run.matched[[first, second]].all() for first, second in pairs)
    first, second = pairs[0]
    assert abs(run.time_s[second] - run.time_s[first] - 7200.0) <= 900.0
    assert spread_pairs(run[:1], 7200.0, 2) == []


@pytest.mark.usefixtures("coarse")
def test_an_album_contains_every_figure_with_material(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from afspm.plugins.drift.registration import Matches
    from afspm.plugins.drift.report import album

    run = record(12)
    scans = [DriftScan(np.random.default_rng(k).normal(size=(16, 16)), REGION, t, t) for k, t in enumerate(run.time_s)]
    at = np.random.default_rng(1).uniform(0.5e-6, 1.5e-6, (9, 2))
    matched = replace(found((0.0, 0.0)), matches=Matches(at, at, np.arange(9) > 2))
    spans = {"off": (0, 4), "on": (4, 12)}
    parts = [album.RunPart(name, f"correction {name}", a, b, run[a:b]) for name, (a, b) in spans.items()]
    whole = album.DriftRun(scans, run, parts, (0, 1, matched), run.drift_m)
    assert whole.switched_on_s == run.time_s[4]
    names = {path.stem for path in album.write(whole, tmp_path)}
    assert names == {
        "drift_offset", "drift_pairs", "drift_estimates_off", "drift_histogram_off", "drift_estimates_on",
        "drift_histogram_on", "drift_features", "drift_errors",
    }  # fmt: skip
    plain = album.DriftRun(scans, run, [album.RunPart("", "Height", 0, 12)])
    assert plain.switched_on_s is None
    assert [path.stem for path in album.write(plain, tmp_path)] == ["drift_offset", "drift_pairs"]
