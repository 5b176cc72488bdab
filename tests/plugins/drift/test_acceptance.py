"""The probability that a match is wrong: its dependence on the evidence, its text, and its fit."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.drift import fit
from benchmarks.drift.trials import Outcome
from scipy.ndimage import gaussian_filter

from afspm.components import Array
from afspm.plugins.drift.doubt.acceptance import MatchEvidence, texture

GOOD = MatchEvidence(
    overlap=0.8, sd_px=0.02, gap=300.0, rival=0.05,
    agreement=1.0, above_repeats=math.inf, texture=math.inf, surprise=1.0, searched=1.0,
)  # fmt: skip


@pytest.mark.parametrize(
    "worse",
    [
        {"overlap": 0.3},
        {"sd_px": 0.5},
        {"gap": 1.0},
        {"rival": 0.95},
        {"agreement": 0.5},
        {"above_repeats": 2.0},
        {"surprise": 60.0},
    ],
)
def test_worse_evidence_of_any_kind_makes_a_match_less_likely(worse: dict[str, float]) -> None:
    assert GOOD.wrong < 0.01
    assert replace(GOOD, **worse).wrong > GOOD.wrong


def test_a_refusal_names_the_strongest_objection_and_the_probability_of_a_wrong_match() -> None:
    assert GOOD.refusal(0.1) == ""
    repeated = replace(GOOD, above_repeats=1.5)
    assert repeated.refusal(0.1).startswith("the surface repeats itself: a site like the others (1.5 standard")
    assert f"wrong with a probability of {repeated.wrong:.0%}" in repeated.refusal(0.1)


def test_a_likely_rival_is_refused_unless_the_displacement_is_expected() -> None:
    repeated = replace(GOOD, rival=0.8)
    assert repeated.wrong < 0.05
    assert "another displacement explains 80%" in repeated.refusal(0.05)
    assert replace(repeated, searched=0.01).refusal(0.05) == ""


def test_bare_ground_without_an_expected_displacement_needs_ten_times_the_certainty() -> None:
    bare = replace(GOOD, texture=0.3, gap=50.0)
    assert 0.005 < bare.wrong < 0.05
    assert "the ground between the features shows nothing in common (0.3 " in bare.refusal(0.05)
    assert replace(bare, texture=2.0).refusal(0.05) == ""
    assert replace(bare, gap=300.0).refusal(0.05) == ""
    assert replace(bare, searched=0.01).refusal(0.05) == ""


def test_texture_between_features_agrees_at_the_same_place_alone() -> None:
    """Two bumps of one shape match wherever they are; the ground around them does not."""
    random = np.random.default_rng(7)
    y, x = np.mgrid[:96, :96] - 47.5
    bump, known = 8.0 * np.exp(-(x**2 + y**2) / 200.0), np.ones((96, 96), dtype=bool)

    def ground() -> Array:
        fine = gaussian_filter(random.standard_normal((96, 96)), 2.5)
        return np.asarray(fine / fine.std())

    def seen(surface: Array) -> Array:
        return np.asarray(gaussian_filter(bump + surface + random.standard_normal((96, 96)), 1.0))

    faint, elsewhere, rough = 0.25 * ground(), 0.25 * ground(), 3.0 * ground()
    assert texture(seen(faint), seen(faint), known) > 3.0
    assert texture(seen(faint), seen(elsewhere), known) < 2.0
    assert texture(seen(rough), seen(rough), known) == math.inf


def test_the_fit_gives_calibrated_probabilities() -> None:
    """Matches that are right or wrong depending only on the agreement of their parts."""
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


def test_ellipses_match_the_errors_and_grow_with_a_significant_doubt() -> None:
    random = np.random.default_rng(3)
    outcomes = []
    for seed in range(8000):
        shared, varied = random.uniform(0.0, 1.0, 2)
        chi2 = 2.0 * math.exp(1.5 * shared) * random.exponential(2.0)
        outcomes.append(_outcome(seed, GOOD, wrong=False, chi2=chi2, varied=varied, shared=shared))
    spread = fit._spread(outcomes)
    assert spread["shared"] == pytest.approx(1.5, abs=0.2)
    assert abs(spread["varied"]) < 0.2
    assert spread["all"] == pytest.approx(2.0 * math.log(1.0 - fit.COVERED) / math.log(0.05), rel=0.15)


def test_no_doubt_makes_an_ellipse_smaller() -> None:
    random = np.random.default_rng(4)
    outcomes = []
    for seed in range(400):
        shared, varied = random.uniform(0.0, 1.0, 2)
        chi2 = 2.0 * math.exp(-1.5 * shared) * random.exponential(2.0)
        outcomes.append(_outcome(seed, GOOD, wrong=False, chi2=chi2, varied=varied, shared=shared))
    spread = fit._spread(outcomes)
    assert all(spread[name] >= 0.0 for name in fit.DOUBTS)


def test_an_interrupted_fit_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[int] = []
    monkeypatch.setattr(fit, "KEPT", tmp_path)
    monkeypatch.setattr(fit, "trials", lambda half, seeds, names: [_Job(seed, ran) for seed in seeds.get("real", [])])
    assert len(fit.gathered("fitted", 2, 1, fit.CELLS)) == 2
    assert len(fit.gathered("fitted", 3, 1, fit.CELLS)) == 3
    assert ran == [fit.SEED, fit.SEED + 1, fit.SEED + 2]


@dataclass
class _Job:
    seed: int
    ran: list[int]
    cell: str = "real"
    surface: str = "rough"

    def run(self) -> list[Outcome]:
        self.ran.append(self.seed)
        return [_outcome(self.seed, GOOD, wrong=False)]


def _outcome(
    seed: int, found: MatchEvidence, *, wrong: bool, chi2: float = 3.0, cell: str = "real", **doubts: float
) -> Outcome:
    usual = {**dict.fromkeys(fit.DOUBTS, 0.0), "spread": 1.0, "spread_of_evidence": 1.0}
    quality = {**asdict(found), **usual, **doubts}
    error = (5.0, 0.0) if wrong else (0.01, 0.0)
    return Outcome(
        cell=cell, surface="rough", estimator="", seed=seed, accepted=True, reason="", error_px=error, chi2=chi2,
        bound_px=0.01, white_bound_px=0.01, cpu_s=0.1, half="fitted", quality=quality,
    )  # fmt: skip
