"""The paper's method under its own parameters: inliers and right displacements by threshold, iterations and pairing.

The features are matched once for each pair; RANSAC then runs with each setting, as the paper describes it: the mean
displacement of the inliers, without the tightening and the acceptance that `plugins.drift.estimators.features` adds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from afspm.plugins.drift.estimators import unguarded
from afspm.plugins.drift.registration.ransac import FORMS, Search
from benchmarks.drift.pairs import PIXEL_M, Pair, Sampling, pair
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import FAILED_PX

KINDS = ("brief", "orb", "sift")
CONDITIONS = ("real", "hard")
PAIRS = 8  # of each surface
THRESHOLDS = (0.01, 0.02, 0.05, 0.1)  # of the scan's side
ITERATIONS = (10, 30, 100, 300)
THRESHOLD, MOST = 0.05, 100  # the paper's
OVERLAPS = (0.9, 0.75, 0.5, 0.35, 0.25)  # against f_min
SIDE_PX = 128
STEPS = {1.0: (128, 1.0), 0.5: (64, 2.0), 0.25: (32, 4.0)}  # sr_norm: pixels of the second scan, and their distance


@dataclass(frozen=True)
class Pairing:
    """The condition of two scans, their overlap if it is not the condition's, and the ratio of their resolutions."""

    condition: str = "real"
    overlap: float | None = None
    sr_norm: float = 1.0


PAIRINGS = (*map(Pairing, CONDITIONS), *(Pairing(overlap=f) for f in OVERLAPS), *(Pairing(sr_norm=s) for s in STEPS))


@dataclass(frozen=True)
class Agreement:
    """The result of one setting with one pair.

    Attributes:
        matches, inliers: their numbers.
        right: share of matches within `FAILED_PX` of the true displacement; NaN without matches.
        off_px: error of the inliers' mean displacement; infinite without inliers.
    """

    pairing: Pairing
    kind: str
    threshold: float
    iterations: int
    matches: int
    inliers: int
    right: float
    off_px: float


@dataclass(frozen=True)
class Matching:
    """A job: one pair, matched once by each kind of features, and RANSAC with each setting."""

    pairing: Pairing
    surface: str
    seed: int
    kinds: tuple[str, ...]

    def run(self) -> list[Agreement]:
        samplings = (Sampling.square(128), Sampling.square(*STEPS[self.pairing.sr_norm]))
        made = pair(self.surface, self.pairing.condition, self.seed, samplings=samplings, overlap=self.pairing.overlap)
        return [one for kind in self.kinds for one in self._of(made, kind)]

    def _of(self, made: Pair, kind: str) -> Iterator[Agreement]:
        assert made.truth is not None, "the scans of these conditions overlap"
        displacement_m = made.truth.displacement_m
        found = unguarded(kind).register(made.reference, made.scan).matches
        a, b = (np.empty((0, 2)),) * 2 if found is None else (found.reference_m, found.scan_m)
        right = float((np.hypot(*(b - a - displacement_m).T) <= FAILED_PX * PIXEL_M).mean()) if len(a) else math.nan
        side_m = float(np.mean([made.reference.region.size_m, made.scan.region.size_m]))
        is_varied = self.pairing in PAIRINGS[: len(CONDITIONS)]
        for threshold in THRESHOLDS if is_varied else (THRESHOLD,):
            for iterations in ITERATIONS if is_varied else (MOST,):
                search = Search(FORMS["translation"], iterations, 1.0, np.random.default_rng(self.seed))
                best = search.among(a, b, threshold * side_m)
                count, off_px = 0, math.inf
                if best is not None:
                    count = best.count
                    off_px = float(np.hypot(*(best.transform.shift - displacement_m))) / PIXEL_M
                yield Agreement(self.pairing, kind, threshold, iterations, len(a), count, right, off_px)


def jobs(plan: Plan) -> list[Matching]:
    kinds = tuple(kind for kind in KINDS if kind in plan.estimators)
    return [
        Matching(pairing, surface, seed, kinds)
        for pairing in dict.fromkeys(PAIRINGS)
        for surface in SURFACES
        for seed in plan.seeds(PAIRS)
    ]


def report(plan: Plan, results: Sequence[Agreement]) -> Report:
    by: dict[tuple[str, Pairing, float, int], list[Agreement]] = {}
    for one in results:
        by.setdefault((one.kind, one.pairing, one.threshold, one.iterations), []).append(one)
    heads = [f"{n} iterations" for n in ITERATIONS]
    ransac = _table("share of inliers | displacements within 1 px | within 5 % of the side", "threshold", heads)
    pairs = _table("the same with the paper's 5 % and 100 iterations", "", ["matches", "right ones", "as above"])
    for (kind, pairing, threshold, iterations), found in by.items():
        if pairing.overlap is None and pairing.sr_norm == 1.0 and iterations == ITERATIONS[0]:
            row = [_figures(by[kind, pairing, threshold, n]) for n in ITERATIONS]
            ransac.add_row(kind, pairing.condition, f"{threshold:.0%}", *row)
        if threshold == THRESHOLD and iterations == MOST:
            matches, right = _mean(o.matches for o in found), _mean(o.right for o in found)
            name = f"overlap {pairing.overlap:.0%}" if pairing.overlap else f"sr_norm {pairing.sr_norm:g}"
            pairs.add_row(kind, pairing.condition, name, f"{matches:.0f}", f"{right:.0%}", _figures(found))
    return Report([ransac, pairs])


def _figures(found: Sequence[Agreement]) -> str:
    shares = (
        _mean(one.inliers / max(one.matches, 1) for one in found),
        _mean(one.off_px <= FAILED_PX for one in found),
        _mean(one.off_px <= THRESHOLD * SIDE_PX for one in found),
    )
    return " | ".join(f"{share:.0%}" for share in shares)


def _mean(values: Iterable[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def _table(title: str, third: str, heads: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for head in ("", "condition", third, *heads):
        table.add_column(head, no_wrap=True)
    return table
