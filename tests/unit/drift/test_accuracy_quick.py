"""The default estimator on a few pairs of the benchmark; `make bench-drift` measures it on thousands."""

from __future__ import annotations

from functools import cache

import pytest
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import Cell, Trial

from afspm.drift.estimators import DEFAULT

# Four pairs of an estimator at the target of 1.25 times the bound come this high with a probability below 1e-3 (chi
# square of eight degrees of freedom); few edges in view have heavier tails.
MOST = 2.3
MOST_OF_STAMPER = 3.0


@cache
def cell(surface: str, condition: str, pairs: int = 4, prior_sd_px: float | None = None) -> Cell:
    trials = [Trial("", surface, condition, seed, (DEFAULT,), prior_sd_px=prior_sd_px) for seed in range(pairs)]
    return Cell.of(outcome for trial in trials for outcome in trial.run())


@pytest.mark.parametrize("condition", ["white30", "real"])
@pytest.mark.parametrize("surface", SURFACES)
def test_errors_are_near_the_bound_and_nothing_wrong_is_accepted(surface: str, condition: str) -> None:
    found = cell(surface, condition)
    assert found.failed == 0.0
    assert found.wrong == 0.0
    assert found.ratio < (MOST_OF_STAMPER if surface == "stamper" else MOST)


def test_most_of_what_is_right_is_accepted() -> None:
    accepted = [cell(surface, "real").accepted for surface in SURFACES]
    assert min(accepted) > 0.0
    assert sum(accepted) / len(accepted) >= 0.95


@pytest.mark.parametrize("surface", SURFACES)
def test_scans_with_nothing_in_common_are_refused(surface: str) -> None:
    assert cell(surface, "null", 2, prior_sd_px=1.0).accepted == 0.0
    if surface != "stamper":  # of which any end of a bump fits any other, unless one knows where to look
        assert cell(surface, "null", 2).accepted == 0.0
