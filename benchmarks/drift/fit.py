"""`python -m benchmarks.drift.fit`: fit the acceptance of the default estimator on the fitted half of the families.

Writes src/afspm/drift/estimators/coefficients.py, or with `--figure` a reliability diagram of what is there, on both
halves. Outcomes are kept in build/, and taken from there with `--again`.
"""

from __future__ import annotations

import argparse
import math
import os
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy.optimize import minimize
from scipy.stats import beta

from afspm.drift.estimators import DEFAULT, acceptance
from afspm.drift.estimators.acceptance import MatchEvidence
from afspm.drift.estimators.coefficients import SPREAD
from benchmarks.drift.conditions import Array
from benchmarks.drift.families import HALVES, Half
from benchmarks.drift.trials import ELLIPSE_95, Outcome
from benchmarks.drift.unseen import trials
from benchmarks.drift.workers import done

PAIRS = {"real": 40, "hard": 32, "null": 32, "null+prior": 32, "hard+prior": 16}
SEED = 20_000
RIDGE = 1.0
KEPT = Path("build")
COEFFICIENTS = Path(acceptance.__file__).with_name("coefficients.py")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift.fit", description=__doc__)
    parser.add_argument("--again", action="store_true", help="with the outcomes of last time")
    parser.add_argument("--figure", type=Path, help="draw how far the probabilities are right")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args(arguments)
    if asked.figure is None:
        COEFFICIENTS.write_text(fitted(_outcomes("fitted", asked)), encoding="utf-8")
    else:
        drawn({half: _outcomes(half, asked) for half in HALVES}, asked.figure)
    print(f"wrote {asked.figure or COEFFICIENTS}")
    return 0


def _outcomes(half: Half, asked: argparse.Namespace) -> list[Outcome]:
    kept = KEPT / f"drift-{half}.pickle"
    if not asked.again:
        jobs = trials(half, {cell: range(SEED, SEED + n) for cell, n in PAIRS.items()}, (DEFAULT,))
        kept.parent.mkdir(exist_ok=True)
        kept.write_bytes(pickle.dumps([one for each in done(jobs, asked.processes).values() for one in each]))
    outcomes: list[Outcome] = pickle.loads(kept.read_bytes())
    return outcomes


def evidence(outcome: Outcome) -> MatchEvidence | None:
    """What the estimator has found for and against its match; None where it has found none."""
    names = [field.name for field in fields(MatchEvidence)]
    return MatchEvidence(**{name: outcome.quality[name] for name in names}) if outcome.quality else None


def fitted(outcomes: Sequence[Outcome]) -> str:
    """The module of coefficients: a logistic regression with a ridge, by features of unit variance."""
    pairs = [(found.features(), one.failed) for one in outcomes if (found := evidence(one)) is not None]
    names = list(pairs[0][0])
    x = np.array([list(features.values()) for features, _ in pairs])
    wrong = np.array([failed for _, failed in pairs], dtype=np.float64)
    right = np.median(x[wrong == 0.0], axis=0)
    scale = x.std(axis=0)
    weights = _logistic((x - right) / scale, wrong)
    rows = [f'    "{name}": {value:.4f},' for name, value in zip(names, weights[1:] / scale, strict=True)]
    middle = [f'    "{name}": {value:.4f},' for name, value in zip(names, right, strict=True)]
    return "\n".join([
        '"""Coefficients of the probability that a match is wrong. Written by `python -m benchmarks.drift.fit`.',
        "",
        f"Fitted to {len(pairs)} pairs of the fitted half of the families, from seed {min(o.seed for o in outcomes)};",
        f"{wrong.sum():.0f} of them were wrong.",
        '"""',
        "",
        f"INTERCEPT = {weights[0]:.4f}",
        "",
        "WEIGHTS = {",
        *rows,
        "}",
        "",
        "RIGHT = {",
        *middle,
        "}",
        '"""The median of right matches."""',
        "",
        f"SPREAD = {_spread(outcomes):.2f}",
        '"""By which covariances are larger than their model says, so that their ellipses hold what they promise."""',
        "",
    ])  # fmt: skip


def _spread(outcomes: Sequence[Outcome]) -> float:
    """From the 95 % quantile of chi square of right matches, which were found with the present factor."""
    chi2 = [one.chi2 for one in outcomes if not one.failed and one.quality]
    return SPREAD * float(np.quantile(chi2, 0.95)) / ELLIPSE_95


def _logistic(x: Array, wrong: Array) -> Array:
    """The intercept and the weights."""
    columns = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    penalty = np.full(columns.shape[1], RIDGE)
    penalty[0] = 0.0

    def cost(weights: Array) -> tuple[float, Array]:
        odds = columns @ weights
        probability = 1.0 / (1.0 + np.exp(-odds))
        value = float(np.sum(np.logaddexp(0.0, odds) - wrong * odds) + np.sum(penalty * weights**2) / 2)
        return value, columns.T @ (probability - wrong) + penalty * weights

    start = np.zeros(columns.shape[1])
    start[0] = math.log(wrong.mean() / (1.0 - wrong.mean()))
    return np.asarray(minimize(cost, start, jac=True, method="BFGS").x)


BINS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.7, 0.9, 0.97, 1.0)


def drawn(outcomes: Mapping[Half, Sequence[Outcome]], path: Path) -> None:
    """Draw which share of the matches was wrong, against the probability that was told of them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(exact := np.geomspace(3e-4, 1.0, 200), exact, color="0.7", linewidth=1, label="exactly right")
    for half, marker, color in zip(HALVES, "os", ("tab:blue", "tab:orange"), strict=True):
        pairs = [(found.wrong, one.failed) for one in outcomes[half] if (found := evidence(one)) is not None]
        told, wrong = np.array(pairs, dtype=np.float64).T
        number = np.digitize(told, BINS[1:-1])
        for k in np.unique(number):
            here = number == k
            n, bad = int(here.sum()), int(wrong[here].sum())
            low = float(beta.ppf(0.025, max(bad, 1e-9), n - bad + 1))
            high = float(beta.ppf(0.975, bad + 1, max(n - bad, 1e-9)))
            at, label = told[here].mean(), half if k == number.min() else None
            axes.plot([at, at], [low, high], color=color, linewidth=1)
            axes.plot(at, bad / n, marker, color=color, markersize=5, label=label)
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=0.01)
    axes.set(xlabel="probability that a match is wrong", ylabel="share that was wrong", ylim=(-0.001, 1.3))
    axes.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    raise SystemExit(main())
