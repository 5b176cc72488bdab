"""Estimators by name, a user's own, and protection from their errors."""

from __future__ import annotations

from dataclasses import replace
from importlib import metadata
from typing import Any

import numpy as np
import pytest

from afspm.basics import ConfigError
from afspm.model import Region
from afspm.plugins.drift.estimators import Guarded, estimator
from afspm.plugins.drift.registration import DriftScan, LinearSeen, Prior, Registration

FOUND = Registration(
    accepted=True,
    reason="",
    displacement_m=np.array([1e-9, 2e-9]),
    covariance_m2=np.eye(2) * 1e-20,
    linear=np.zeros((2, 2)),
    center_m=np.zeros(2),
)


class Told:
    """An estimator with a given result."""

    def __init__(self, answer: Any = FOUND, gain: float = 1.0) -> None:
        if gain < 0.0:
            raise ValueError("the gain is negative")
        self.answer = answer
        self.gain = gain

    def register(self, reference: DriftScan, scan: DriftScan, prior: Prior | None = None) -> Any:
        if isinstance(self.answer, Exception):
            raise self.answer
        reference.values[:] = 0.0
        return self.answer


def a_scan() -> DriftScan:
    return DriftScan(np.ones((4, 5)), Region((0, 0), (1e-6, 1e-6)), 0.0, 1.0)


def said(answer: Any) -> Registration:
    return estimator(Told(answer)).register(a_scan(), a_scan())


def test_a_right_result_passes_unchanged() -> None:
    assert said(FOUND) is FOUND
    refused = Registration.refused("nothing in common")
    assert said(refused) is refused


def wrong(**changes: Any) -> Registration:
    return replace(FOUND, **changes)


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        (ZeroDivisionError("oh"), "ZeroDivisionError: oh"),
        (MemoryError(), "MemoryError"),
        (None, "NoneType"),
        (replace(FOUND, displacement_m=np.array([np.nan, 0.0])), "displacement_m"),
        (replace(FOUND, center_m=np.array([np.inf, 0.0])), "center_m"),
        (replace(FOUND, displacement_m=np.zeros(3)), "shape"),
        (wrong(linear=(0, 0)), "linear"),
        (replace(FOUND, covariance_m2=np.zeros((2, 2))), "covariance"),
        (replace(FOUND, covariance_m2=np.diag([1e-20, -1e-20])), "covariance"),
        (replace(FOUND, covariance_m2=np.array([[1e-20, 9e-21], [0.0, 1e-20]])), "covariance"),
        (replace(Registration.refused("x"), reason=""), "without a reason"),
        (replace(FOUND, linear=np.diag([-2.0, 0.0])), "mirrored"),
        (replace(FOUND, linear=np.diag([-1.0, 0.0])), "mirrored or flat"),
        (replace(FOUND, linear=np.diag([0.0, 1.5])), "stretched by 2.5"),
        (wrong(linear_seen=np.zeros((2, 2))), "instead of a LinearSeen"),
        (replace(FOUND, linear_seen=LinearSeen(np.zeros((2, 2)), np.eye(2))), "shapes (2, 2) and (4, 4)"),
        (replace(FOUND, linear_seen=LinearSeen(np.full((2, 2), np.nan), np.eye(4))), "finite"),
        (replace(FOUND, linear_seen=LinearSeen(np.zeros((2, 2)), -np.eye(4))), "invalid covariance"),
        (replace(FOUND, linear_seen=LinearSeen(np.diag([0.0, 1.5]), np.eye(4))), "stretched by 2.5"),
        (replace(FOUND, displacement_m=np.array([-1.1e-6, 0.0])), "do not overlap"),
    ],
)
def test_a_malformed_result_fails_with_the_reason(answer: Any, reason: str) -> None:
    found = said(answer)
    assert not found.accepted
    assert "Told" in found.reason
    assert reason in found.reason


def test_a_rotation_and_a_displacement_by_most_of_a_frame_are_possible() -> None:
    turned = replace(FOUND, linear=np.array([[0.0, -1.0], [1.0, 0.0]]) - np.eye(2), displacement_m=np.array([9e-7, 0]))
    assert said(turned) is turned


def test_an_estimator_can_not_change_the_scans_it_is_given() -> None:
    reference = a_scan()
    estimator(Told()).register(reference, a_scan())
    assert (reference.values == 1.0).all()


def test_a_user_s_own_estimator_is_named_by_its_class_and_gets_its_settings() -> None:
    made = estimator({"class": f"{__name__}.Told", "gain": 3.0})
    assert isinstance(made, Guarded)
    assert isinstance(made.inner, Told)
    assert made.inner.gain == 3.0
    assert isinstance(estimator(f"{__name__}.Told"), Guarded)
    assert estimator(made) is made


@pytest.mark.parametrize(
    ("spec", "says"),
    [
        ("breif", "did you mean 'brief'"),
        ("Least-Squares", "did you mean 'least-squares'"),
        ("zzz", "brief, correlation, least-squares, orb, sift"),
        ({"class": 3}, "text"),
        ({"class": f"{__name__}.Tolt"}, "did you mean 'Told'"),
        ({"class": "no_such_module.Thing"}, "is it installed"),
        ({"class": f"{__name__}.Told", "gian": 1.0}, "did you mean 'gain'"),
        ({"class": f"{__name__}.Told", "gain": -1.0}, "the gain is negative"),
        ({"class": "pathlib.PurePath"}, "is not an estimator"),
        (object(), "is not an estimator"),
    ],
)
def test_an_unknown_name_is_refused_with_the_known_ones(spec: Any, says: str) -> None:
    with pytest.raises(ConfigError) as refused:
        estimator(spec)
    assert says in str(refused.value)


def test_a_missing_library_is_reported_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = metadata.version

    def version(name: str) -> str:
        if name == "scikit-image":
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(metadata, "version", version)
    with pytest.raises(ConfigError) as refused:
        estimator("sift")
    assert (
        str(refused.value) == 'Sift needs packages that are not installed: scikit-image (pip install "afspm[features]")'
    )


def test_the_default_accepts_its_threshold_as_in_the_experiment_file() -> None:
    random = np.random.default_rng(3)
    values = random.normal(size=(64, 64)).cumsum(0).cumsum(1)
    first, second = (
        DriftScan(values + random.normal(size=(64, 64)), Region((0, 0), (1e-6, 1e-6)), 0.0, 1.0) for _ in range(2)
    )
    found = estimator("least-squares").register(first, second)
    assert found.accepted
    strict = estimator({"class": "least-squares", "wrong_at_most": found.quality["wrong"] / 2})
    refused = strict.register(first, second)
    assert not refused.accepted
    assert "wrong with a probability of" in refused.reason


@pytest.mark.parametrize("value", [0.0, 1.0, -0.5, True])
def test_an_impossible_probability_is_refused(value: float) -> None:
    with pytest.raises(ConfigError, match="wrong_at_most"):
        estimator({"class": "least-squares", "wrong_at_most": value})
