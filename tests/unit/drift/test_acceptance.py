"""The probability that a match is wrong: what raises it, what is said of it, and how it is fitted."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from benchmarks.drift import fit
from benchmarks.drift.trials import ELLIPSE_95, Outcome

from afspm.drift.estimators.acceptance import MatchEvidence
from afspm.drift.estimators.coefficients import SPREAD

GOOD = MatchEvidence(
    overlap=0.8, sd_px=0.02, gap=300.0, rival=0.05,
    agreement=1.0, correlation=0.99, above_repeats=math.inf, surprise=1.0,
)  # fmt: skip


@pytest.mark.parametrize(
    "worse",
    [
        {"overlap": 0.3},
        {"sd_px": 0.5},
        {"gap": 1.0},
        {"rival": 0.95},
        {"agreement": 0.5},
        {"correlation": 0.5},
        {"above_repeats": 2.0},
        {"surprise": 60.0},
    ],
)
def test_worse_evidence_of_any_kind_makes_a_match_less_likely(worse: dict[str, float]) -> None:
    assert GOOD.wrong < 0.01
    assert replace(GOOD, **worse).wrong > GOOD.wrong


def test_a_refusal_names_what_speaks_most_against_the_match_and_how_likely_it_is_wrong() -> None:
    assert GOOD.refusal(0.1) == ""
    repeated = replace(GOOD, above_repeats=1.5)
    assert repeated.refusal(0.1).startswith("the surface repeats itself: a site like the others (1.5 standard")
    assert f"wrong with a probability of {repeated.wrong:.0%}" in repeated.refusal(0.1)


def test_the_fit_tells_probabilities_that_are_right() -> None:
    """Of matches of which only the agreement of their parts says whether they are wrong."""
    random = np.random.default_rng(2)
    outcomes, told = [], []
    for seed in range(3000):
        found = replace(GOOD, agreement=float(random.uniform(0.0, 1.0)), gap=float(random.uniform(1.0, 300.0)))
        probability = 1.0 / (1.0 + math.exp(10.0 * (found.agreement - 0.5)))
        outcomes.append(_outcome(seed, found, wrong=bool(random.random() < probability)))
        told.append(probability)
    module: dict[str, Any] = {}
    exec(fit.fitted(outcomes), module)
    assert module["WEIGHTS"]["agreement"] == pytest.approx(-10.0, rel=0.1)
    assert abs(module["WEIGHTS"]["gap"]) < 0.2
    assert module["SPREAD"] == pytest.approx(SPREAD * 3.0 / ELLIPSE_95, rel=0.01)


def _outcome(seed: int, found: MatchEvidence, *, wrong: bool) -> Outcome:
    error = (5.0, 0.0) if wrong else (0.01, 0.0)
    return Outcome(
        cell="real", surface="rough", estimator="", seed=seed, accepted=True, reason="", error_px=error, chi2=3.0,
        bound_px=0.01, white_bound_px=0.01, cpu_s=0.1, half="fitted", quality=asdict(found),
    )  # fmt: skip
