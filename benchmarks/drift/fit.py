"""`python -m benchmarks.drift.fit`: fit the probabilities and the ellipses of the default estimator.

Uses the fitted half of the families alone. Writes plugins/drift/doubt/coefficients.py, or with `--figure` a reliability
diagram of the present coefficients, on both halves. The outcomes of all pairs are kept in build/ as they come: an
interrupted run continues, and a run with more rounds adds to them. After a change of the estimator delete this file.
"""

from __future__ import annotations

import argparse
import math
import os
import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from scipy import sparse
from scipy.optimize import linprog, minimize
from scipy.stats import beta

from afspm.components import Array
from afspm.plugins.drift.doubt import acceptance
from afspm.plugins.drift.doubt.acceptance import MatchEvidence
from afspm.plugins.drift.doubt.coefficients import SPREAD
from afspm.plugins.drift.estimators import DEFAULT
from benchmarks.drift.families import HALVES, Half
from benchmarks.drift.trials import ELLIPSE_95, Outcome, Trial
from benchmarks.drift.unseen import trials
from benchmarks.drift.workers import done

HARD = ("hard", "hard+prior")
CELLS = ("real", *HARD, "null", "null+prior", "zoom+prior", "null-zoom+prior")
AT_ONCE = 200  # jobs, before their outcomes are kept
SEED = 20_000
MORE_SEEDS = (30_000, 40_000)  # of stampers alone: how well they are known is the hardest to tell
RIDGE = 1.0
KEPT = Path("build")
COEFFICIENTS = Path(acceptance.__file__).with_name("coefficients.py")
DOUBTS = ("varied", "shared", "unclear", "leverage")
COVERED = 0.96  # of right matches, by the ellipses of 95 %: on others it will be less
DOMAIN = 0.99  # of accepted right matches are within the largest spread
TURNS = 3  # who is accepted depends on the spread, and that is fitted to those who are


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift.fit", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100, help="of one pair for each surface and condition")
    parser.add_argument("--figure", type=Path, help="draw how far the probabilities are right")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args(arguments)
    halves: tuple[Half, ...] = HALVES[:1] if asked.figure is None else HALVES
    outcomes = {half: gathered(half, asked.rounds, asked.processes, CELLS) for half in halves}
    if asked.figure is None:
        COEFFICIENTS.write_text(fitted(outcomes["fitted"]), encoding="utf-8")
    else:
        drawn(outcomes, asked.figure)
    print(f"wrote {asked.figure or COEFFICIENTS}")
    return 0


def gathered(half: Half, rounds: int, processes: int, cells: Sequence[str]) -> list[Outcome]:
    """Return the outcomes of `rounds` rounds: the kept ones, and the missing ones, which are computed and kept."""
    file = KEPT / f"drift-{half}.pickles"
    file.parent.mkdir(exist_ok=True)
    kept = list(_kept(file))
    known = {(one.cell, one.surface, one.seed) for one in kept}
    wanted = [job for number in range(rounds) for job in _round(half, number, cells)]
    for first in range(0, len(wanted), AT_ONCE):
        some = wanted[first : first + AT_ONCE]
        missing = [job for job in some if (job.cell, job.surface, job.seed) not in known]
        with file.open("ab") as written:
            for one in _outcomes(missing, processes):
                pickle.dump(one, written)
                kept.append(one)
    chosen = {(job.cell, job.surface, job.seed) for job in wanted}
    return [one for one in kept if (one.cell, one.surface, one.seed) in chosen]


def _round(half: Half, number: int, cells: Sequence[str]) -> list[Trial]:
    # a pair of each surface in each cell, and more of stampers in cells where they are hard
    hard = [cell for cell in cells if cell in HARD]
    more = trials(half, {cell: [seed + number for seed in MORE_SEEDS] for cell in hard}, (DEFAULT,))
    plain = trials(half, {cell: [SEED + number] for cell in cells}, (DEFAULT,))
    return [
        *plain,
        *(job for job in more if job.surface == "stamper"),
    ]


def _kept(file: Path) -> Iterator[Outcome]:
    if not file.exists():
        return
    with file.open("rb") as written:
        while True:
            try:
                yield pickle.load(written)
            except EOFError:
                return


def _outcomes(jobs: Sequence[Trial], processes: int) -> list[Outcome]:
    if not jobs:
        return []
    found = [job.run() for job in jobs] if processes == 1 else done(jobs, processes).values()
    return [one for each in found for one in each]


def evidence(outcome: Outcome) -> MatchEvidence | None:
    """Return the estimator's evidence for its match; None without a match."""
    names = [field.name for field in fields(MatchEvidence)]
    return MatchEvidence(**{name: outcome.quality[name] for name in names}) if outcome.quality else None


def fitted(outcomes: Sequence[Outcome]) -> str:
    """Return the module of coefficients: a logistic regression with a ridge, and the spread of the ellipses.

    The regression uses features of unit variance.
    """
    found = [(one, each) for one in outcomes if (each := evidence(one)) is not None]
    wrong = np.array([one.failed for one, _ in found], dtype=np.float64)
    accepted = np.array([one.accepted for one, _ in found])
    for _ in range(TURNS):
        spread = _spread([one for (one, _), sure in zip(found, accepted, strict=True) if sure and not one.failed])
        features = [_with_spread(each, one, spread).features() for one, each in found]
        x = np.array([list(one.values()) for one in features])
        right = np.median(x[wrong == 0.0], axis=0)
        scale = np.maximum(x.std(axis=0), 1e-9)  # a feature equal in all pairs gets no weight
        weights = _logistic((x - right) / scale, wrong)
        probability = 1.0 / (1.0 + np.exp(-weights[0] - (x - right) / scale @ weights[1:]))
        accepted = probability <= acceptance.WRONG_AT_MOST
    names = list(features[0])
    return "\n".join([
        '"""Coefficients of the default estimator. Written by `python -m benchmarks.drift.fit`.',
        "",
        f"Fitted to {len(found)} pairs of the fitted half of the families, from seed {min(o.seed for o in outcomes)};",
        f"{wrong.sum():.0f} of them were wrong.",
        '"""',
        "",
        f"INTERCEPT = {weights[0]:.4f}",
        '"""Of the logarithm of the odds that a match is wrong, when it is as the median of right ones."""',
        "",
        *_table("WEIGHTS", names, weights[1:] / scale),
        "",
        *_table("RIGHT", names, right),
        '"""The median of right matches."""',
        "",
        *_table("SPREAD", list(spread), list(spread.values())),
        '"""Ratio of true covariances to those of the model, in the evidence for a match, see `Doubt`."""',
        "",
    ])  # fmt: skip


def _doubts(outcomes: Sequence[Outcome]) -> Array:
    return np.array([[1.0, *(one.quality[name] for name in DOUBTS)] for one in outcomes])


def _table(title: str, names: Sequence[str], values: Sequence[float] | Array) -> list[str]:
    return [f"{title} = {{", *(f'    "{n}": {v:.4f},' for n, v in zip(names, values, strict=True)), "}"]


def _with_spread(found: MatchEvidence, outcome: Outcome, spread: Mapping[str, float]) -> MatchEvidence:
    # the evidence was computed with another spread
    changed = math.exp(_log_spread(outcome, spread)) / outcome.quality["spread_of_evidence"]
    return replace(found, sd_px=found.sd_px * math.sqrt(changed))


def _log_spread(outcome: Outcome, spread: Mapping[str, float]) -> float:
    found = math.log(spread["all"]) + sum(spread[name] * outcome.quality[name] for name in DOUBTS)
    return min(found, math.log(spread["most"]))


def _spread(right: Sequence[Outcome]) -> dict[str, float]:
    # Factor on the model of accepted right matches, so that ellipses of 95 % contain `COVERED` of them at any doubt:
    # linear quantile regression (Koenker and Bassett, Econometrica 46, 33, 1978).
    log_chi2 = np.log([max(one.chi2 * one.quality["spread"], 1e-6) / ELLIPSE_95 for one in right])
    columns = _doubts(right)
    count, free = columns.shape
    cost = np.concatenate([np.zeros(2 * free), np.full(count, COVERED), np.full(count, 1.0 - COVERED)])
    parts: list[Any] = [columns, -columns, sparse.eye(count), -sparse.eye(count)]
    equal: Any = sparse.hstack(parts)
    # a sign of doubt never makes an ellipse smaller, as chance would have it in few pairs
    limits = [(0.0, None)] * (free + 1) + [(0.0, 0.0)] * len(DOUBTS) + [(0.0, None)] * (2 * count)
    found = linprog(cost, A_eq=equal, b_eq=log_chi2, bounds=limits).x
    assert found is not None, "there is always a solution"
    best = found[:free] - found[free : 2 * free]
    most = math.exp(np.quantile(columns @ best, DOMAIN))
    return {"all": math.exp(best[0]), **dict(zip(DOUBTS, best[1:].tolist(), strict=True)), "most": most}


def _logistic(x: Array, wrong: Array) -> Array:
    # the intercept and the weights
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
    """Draw the share of wrong matches against their predicted probability."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(exact := np.geomspace(3e-4, 1.0, 200), exact, color="0.7", linewidth=1, label="exactly right")
    for half, marker, color in zip(HALVES, "os", ("tab:blue", "tab:orange"), strict=True):
        found = [(evidence(one), one) for one in outcomes[half]]
        pairs = [(_with_spread(each, one, SPREAD).wrong, one.failed) for each, one in found if each is not None]
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
