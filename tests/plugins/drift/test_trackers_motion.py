"""The models of motion in the filters of the bank."""

from __future__ import annotations

import json

import numpy as np
import pytest

from afspm.components import from_plain, to_plain
from afspm.plugins.drift.track.filters import Models
from afspm.plugins.drift.track.forecast import Compensation

MODELS = Models(np.full(4, 2e-24), np.array([0.0, 1 / 10800.0, 1 / 2700.0, 1 / 30.0]), np.full(4, 5e-22))


@pytest.mark.parametrize(("first_s", "second_s"), [(900.0, 900.0), (20.0, 1.0), (0.001, 26.999), (3600.0, 0.1)])
def test_two_steps_of_a_model_equal_one_long_step(first_s: float, second_s: float) -> None:
    """Also across the step length at which a series replaces the exponentials."""
    (f1, q1), (f2, q2), (f, q) = MODELS.over(first_s), MODELS.over(second_s), MODELS.over(first_s + second_s)
    assert np.allclose(f2 @ f1, f, rtol=1e-12)
    together = f2 @ q1 @ f2.transpose(0, 2, 1) + q2
    assert np.allclose(together, q, rtol=1e-6, atol=0.0)


def test_a_constant_velocity_model_matches_the_textbook() -> None:
    f, q = (part[0] for part in MODELS.over(100.0))
    assert f[0, 2] == 100.0
    assert q[0, 0] == pytest.approx(2e-24 * 100.0**3 / 3 + 5e-22 * 100.0)
    assert q[0, 2] == pytest.approx(2e-24 * 100.0**2 / 2)
    assert q[2, 2] == pytest.approx(2e-24 * 100.0)
    assert q[0, 1] == q[0, 3] == 0.0


def test_a_fading_velocity_comes_to_rest() -> None:
    f, q = (part[3] for part in MODELS.over(3000.0))
    assert f[0, 2] == pytest.approx(30.0)
    assert f[2, 2] == pytest.approx(0.0, abs=1e-30)
    assert q[2, 2] == pytest.approx(2e-24 * 30.0 / 2)


@pytest.mark.parametrize("step_s", [-2000.0, -1.0, 0.0, 1e-3, 26.0, 28.0, 1e6])
def test_the_added_covariance_is_a_covariance(step_s: float) -> None:
    _, q = MODELS.over(step_s)
    scale = np.sqrt(np.einsum("nii->ni", q)) + 1e-300
    assert np.linalg.eigvalsh(q / scale[:, :, None] / scale[:, None, :]).min() > -1e-9


def test_the_mean_over_a_scan_differs_from_its_middle_by_the_wandering() -> None:
    """Against the covariances of a walk and of an integrated random acceleration (Wiener processes), row by row."""
    duration_s, rows = 256.0, 512
    t = duration_s * ((np.arange(rows // 2) + 0.5) / rows)  # from the middle on: both halves are alike
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    mean = np.full(t.size, 1.0 / rows)
    walk = 2 * mean @ early @ mean
    accelerated = 2 * mean @ (early**2 * (3 * late - early) / 6) @ mean
    expected = MODELS.walk_m2_s * walk + MODELS.density_m2_s3 * accelerated
    assert MODELS.wandered_m2(duration_s) == pytest.approx(expected, rel=0.01)


def test_a_controller_follows_in_steps() -> None:
    nothing = Compensation()
    first = nothing.changed(100.0, np.array([1.0, 0.0]), needed_s=0.0)
    second = first.changed(200.0, np.array([0.0, 2.0]), needed_s=150.0)
    assert nothing.followed_m(0.0, 1e6).tolist() == [0.0, 0.0]
    assert second.followed_m(50.0, 250.0).tolist() == [100.0, 100.0]
    assert second.followed_m(250.0, 50.0).tolist() == [-100.0, -100.0]
    assert second.velocity_m_s(150.0).tolist() == [1.0, 0.0]
    assert from_plain(Compensation, json.loads(json.dumps(to_plain(second)))) == second


def test_changes_no_longer_needed_are_forgotten() -> None:
    changing = Compensation()
    for k in range(100):
        changing = changing.changed(float(k), np.array([k, 0.0]), needed_s=k - 1.5)
    assert len(changing.changes) <= 4
    assert changing.velocity_m_s(98.5)[0] == 98.0
