"""The default estimator on a few pairs of the benchmark; `make bench-drift` measures it on thousands."""

from __future__ import annotations

import pytest
from benchmarks.drift.pairs import pair
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import Cell, Trial

from afspm.plugins.drift.estimators import DEFAULT, unguarded

# Two pairs of an estimator at the target of 1.25 times the bound come this high with a probability of 1 % (chi square
# of four degrees of freedom), and these two do not; few edges in view have heavier tails.
MOST = 2.3
MOST_OF_STAMPER = 3.0


@pytest.mark.parametrize("condition", ["white30", "real"])
@pytest.mark.parametrize("surface", SURFACES)
def test_errors_are_near_the_bound_and_right_matches_accepted(surface: str, condition: str) -> None:
    trials = [Trial("", surface, condition, seed, (DEFAULT,)) for seed in range(2)]
    found = Cell.of(outcome for trial in trials for outcome in trial.run())
    assert found.accepted == 1.0
    assert found.failed == 0.0
    assert found.wrong == 0.0
    assert found.ratio < (MOST_OF_STAMPER if surface == "stamper" else MOST)


@pytest.mark.parametrize("surface", SURFACES)
def test_unrelated_scans_are_refused(surface: str) -> None:
    register = unguarded().register
    for seed in range(1):
        made = pair(surface, "null", seed, prior_sd_px=1.0)
        assert not register(made.reference, made.scan, made.prior).accepted
        if surface != "stamper":  # of which any end of a bump fits any other, unless one knows where to look
            assert not register(made.reference, made.scan, None).accepted
