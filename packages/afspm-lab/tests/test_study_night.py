"""A simulated night: its metrics match its events."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from afspm.plugins.drift.registration import DriftScan, Prior, Registration
from afspm_lab.study.night import night
from afspm_lab.study.settings import NightSettings

SMALL: dict[str, Any] = {"pixels": 32, "hours": 2.0, "surface": "particles", "size_m": 1e-6, "tracker": "paper"}


class Still:
    """An estimator whose displacement is always zero."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        followed = np.subtract(scan.region.center_m, reference.region.center_m)
        return Registration(
            accepted=True,
            reason="",
            displacement_m=followed,
            covariance_m2=1e-18 * np.eye(2),
            linear=np.zeros((2, 2)),
            center_m=np.array(reference.region.center_m),
        )


class Blind:
    """An estimator that refuses every pair."""

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Registration:
        return Registration.refused("nothing to be seen")


def settings(**names: Any) -> NightSettings:
    return NightSettings.of(SMALL | names)


def test_a_followed_night_keeps_its_place() -> None:
    followed = night(settings(pixels=64, estimator="correlation", drift_m=0.5e-6), seed=3)
    still = night(settings(estimator=f"{__name__}.Still", drift_m=0.5e-6), seed=3)
    assert followed.record.matched.all()
    assert still.misplaced_m[-1] > 100e-9, "without following, the place is lost"
    assert followed.misplaced_m[3:].max() < 50e-9
    assert np.abs(followed.unknown_m).max() < 16e-9, "a pixel"


def test_an_estimator_without_motion_is_off_by_the_whole_drift() -> None:
    wrong = night(settings(estimator=f"{__name__}.Still"), seed=1)
    np.testing.assert_allclose(wrong.misplaced_m, np.hypot(*wrong.truth_m.T), atol=1e-15)
    np.testing.assert_allclose(wrong.unknown_m, -wrong.truth_m, atol=1e-15)
    told = wrong.metrics()
    assert told["unknown at the end"] == pytest.approx(1e9 * np.hypot(*wrong.truth_m[-1]))
    assert told["first jump"] == pytest.approx(1e9 * np.hypot(*wrong.truth_m[1]))
    assert told["within 95 %"] == 0.0
    assert told["rescans"] == told["refused"] == 0.0


def test_an_estimator_that_refuses_everything_is_lost() -> None:
    blind = night(settings(estimator=f"{__name__}.Blind"), seed=1)
    assert blind.lost
    assert blind.metrics()["refused"] == len(blind.record) - 1


def test_the_same_seed_is_the_same_night_for_all_settings() -> None:
    first, again, other = (night(settings(estimator=f"{__name__}.Still"), seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.truth_m, again.truth_m)
    assert np.abs(first.truth_m - other.truth_m).max() > 1e-9


@pytest.mark.parametrize("rule", ["paper", "tolerance"])
def test_a_scan_too_far_off_is_taken_again(rule: str) -> None:
    jumping = {"estimator": "correlation", "pixels": 64, "drift_m": 3e-6, "every_s": 900.0, "hours": 1.5}
    told = {"f_rescan": 0.95, "tolerance_m": 30e-9}
    again = night(settings(**jumping, **told, rescan=rule), seed=3)
    never = night(settings(**jumping, rescan="never"), seed=3)
    assert never.rescans == 0
    assert again.rescans > 0
    assert len(again.record) == settings(**jumping).scans + again.rescans
