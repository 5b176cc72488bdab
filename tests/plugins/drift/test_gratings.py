"""Gratings: without an expected displacement no match one period away is accepted; with one the right match is."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.drift.foreign_pairs import PIXEL_M
from benchmarks.drift.gratings import grating

from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import Prior


@pytest.mark.parametrize("seed", [1007, 1023, 1048])
def test_gratings_of_other_places_are_refused(seed: int) -> None:
    made = grating("elsewhere", seed)
    found = LeastSquares().register(made.reference, made.scan)
    assert not found.accepted
    assert "the surface repeats itself" in found.reason


@pytest.mark.parametrize("seed", [7001, 7003, 7004])
def test_relaxing_gratings_match_at_the_right_period(seed: int) -> None:
    """Without its own distortion for each candidate the best match is one or two periods off."""
    made = grating("relaxing", seed)
    found = LeastSquares().register(made.reference, made.scan)
    at_px = found.center_m / PIXEL_M - made.center_px
    assert np.hypot(*(found.displacement_m / PIXEL_M - made.moved_px - made.linear @ at_px)) < 1.0


@pytest.mark.parametrize("seed", [1020, 1030, 1047])
def test_relaxing_gratings_are_never_accepted_a_period_off(seed: int) -> None:
    """Their best match is, and a prediction that is good to a part of the period decides."""
    made = grating("relaxing", seed)
    assert not LeastSquares().register(made.reference, made.scan).accepted
    prior = Prior(PIXEL_M * made.moved_px, (1.5 * PIXEL_M) ** 2 * np.eye(2))
    found = LeastSquares().register(made.reference, made.scan, prior)
    at_px = found.center_m / PIXEL_M - made.center_px
    assert found.accepted
    assert np.hypot(*(found.displacement_m / PIXEL_M - made.moved_px - made.linear @ at_px)) < 1.0
