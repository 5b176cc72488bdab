"""Drift tracking through simulated nights: misplacement of the scans, and accumulated errors.

All errors are relative to the first scan. "Late" is from the ninth scan on, two hours after the start. The oracle knows
the true drift of all scans so far and predicts with the same filters: its error is unpredictable drift.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from afspm.plugins.drift.estimators import unguarded
from afspm.plugins.drift.track import tracker
from afspm.plugins.drift.track.tracking import Tracker
from benchmarks.drift.families import Half
from benchmarks.drift.nights import Night, Oracle
from benchmarks.drift.pairs import PIXEL_M
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.rows import Row

SCANS = 32
LATE = 8
NIGHTS = {"rough": 3, "particles": 1, "steps": 1, "stamper": 1}
# A thousand would take longer than all the rest. If errors added up, they would grow with the root of the number.
LONG_SCANS = 200
LONG_REFERENCES = 2
STARTS = {"rough": 6, "stamper": 4}
# Of the unseen half of the families: nights of each surface, and scans of a night.
UNSEEN, UNSEEN_SCANS = 4, 24
# Nights whose lines wander, by as much as in a slow series of a real AFM, correlated over ten lines.
WANDERING, WANDER_PX = {"rough": 2, "particles": 2, "steps": 2}, 0.2

OURS, ORACLE, PAPER, FEATURES = "bank", "oracle, bank", "paper's scheme", "paper's scheme, brief"
FIRST_ORDER, ONE_WAY, LONG = "oracle, paper's scheme", "bank, upwards only", "bank, long"


@dataclass(frozen=True)
class Followed:
    """The result of one night; all in m, (scans, 2) flattened.

    Attributes:
        misplaced: predicted minus true position of each scan.
        mistaken: estimated minus true position after each scan.
        unmatched, lost: number of such scans.
        half: of the families; None: a standard sample and microscope.
        lost_at_end: the sample was never found again.
        wander_px: standard deviation of the wander of the lines.
        chi2: of the known drift about its mean error, which is the first scan's own: mean per degree of freedom.
    """

    scheme: str
    surface: str
    misplaced: tuple[float, ...]
    mistaken: tuple[float, ...]
    unmatched: int
    lost: int
    half: Half | None = None
    lost_at_end: bool = False
    wander_px: float = 0.0
    chi2: float = math.nan

    @property
    def misplaced_m(self) -> NDArray[np.float64]:
        return np.reshape(self.misplaced, (-1, 2))

    @property
    def mistaken_m(self) -> NDArray[np.float64]:
        return np.reshape(self.mistaken, (-1, 2))


@dataclass(frozen=True)
class Track:
    """A job: one night, one scheme."""

    scheme: str
    surface: str
    seed: int
    scans: int
    estimator: str
    half: Half | None = None
    wander_px: float = 0.0

    def run(self) -> list[Followed]:
        night = Night(self.surface, self.seed, self.scans, self.half, self.wander_px)
        misplaced, mistaken, covariances, unmatched, lost, last = [], [], [], 0, 0, False
        for drift_m, update in night.followed(self._tracker(night), up_and_down=self.scheme == OURS):
            misplaced += list(-update.before.mapping.translation_m - drift_m)
            mistaken += list(-update.after.mapping.translation_m - drift_m)
            covariances.append(update.after.covariance_m2)
            unmatched += not update.matched
            lost += update.lost
            last = update.lost
        found = tuple(misplaced), tuple(mistaken)
        chi2 = _chi2(np.reshape(mistaken, (-1, 2))[1:], covariances[1:]) if self.wander_px else math.nan
        return [Followed(self.scheme, self.surface, *found, unmatched, lost, self.half, last, self.wander_px, chi2)]

    def _tracker(self, night: Night) -> Tracker:
        kind = "paper" if self.scheme in (PAPER, FEATURES, FIRST_ORDER) else "bank"
        if self.scheme in (ORACLE, FIRST_ORDER):
            return tracker({"class": kind, **({"compared": 1} if kind == "bank" else {})}, Oracle(night.drift))
        settings = {"compared": LONG_REFERENCES} if self.scheme == LONG else {}
        return tracker({"class": kind, **settings}, unguarded(self.estimator))


def jobs(plan: Plan) -> list[Track]:
    scans = SCANS // 2 if plan.quick else SCANS
    found = [Track(LONG, "rough", plan.seed, LONG_SCANS // 8 if plan.quick else LONG_SCANS, plan.ours)]
    schemes = [(OURS, plan.ours), (ORACLE, ""), (FIRST_ORDER, ""), (PAPER, plan.ours)]
    if "brief" in plan.estimators:
        schemes.append((FEATURES, "brief"))
    for surface, count in NIGHTS.items():
        for seed in range(plan.seed, plan.seed + (1 if plan.quick else count)):
            found += [Track(scheme, surface, seed, scans, name) for scheme, name in schemes]
    for surface in SURFACES:
        for seed in range(plan.seed, plan.seed + (1 if plan.quick else UNSEEN)):
            found += [Track(scheme, surface, seed, UNSEEN_SCANS, name, "unseen") for scheme, name in schemes[:2]]
    for surface, count in WANDERING.items():
        for seed in range(plan.seed, plan.seed + (1 if plan.quick else count)):
            found.append(Track(OURS, surface, seed, UNSEEN_SCANS, plan.ours, wander_px=WANDER_PX))
    for surface, count in STARTS.items():
        for seed in plan.seeds(count):
            found += [Track(scheme, surface, seed + 500, 2, plan.ours) for scheme in (OURS, ONE_WAY)]
    return found


def report(plan: Plan, results: Sequence[Followed]) -> Report:
    unseen = [one for one in results if one.half is not None]
    wandering = [one for one in results if one.wander_px]
    results = [one for one in results if one.half is None and not one.wander_px]
    nights = [one for one in results if one.scheme != LONG and len(one.misplaced) > 4]
    starts = [one for one in results if one.scheme != LONG and len(one.misplaced) == 4]
    long = next(one for one in results if one.scheme == LONG)
    table = Table(title="followed through nights: nm", title_justify="left", box=None, pad_edge=False)
    for head in ("scheme", "surface", "nights", "late RMS", "max", "known RMS", "unmatched", "lost"):
        table.add_column(head)
    for scheme in (OURS, ORACLE, FIRST_ORDER, PAPER, FEATURES):
        for surface in NIGHTS:
            if here := [one for one in nights if (one.scheme, one.surface) == (scheme, surface)]:
                table.add_row(scheme, surface, str(len(here)), *_figures(here))
    table.add_row(f"{LONG}, {len(long.misplaced_m)} scans", long.surface, "1", *_figures([long]))
    for scheme in (OURS, ONE_WAY):
        first = [one for one in starts if one.scheme == scheme]
        table.add_row(f"{scheme}: first jump", "rough, stamper", str(len(first)), f"{_jump_m(first) * 1e9:.1f}")
    rows = [*_rows(nights, starts, long), *_unseen_rows(unseen), *_wandering_rows(wandering)]
    return Report([table, _unseen_table(unseen)], rows)


def _unseen_table(nights: Sequence[Followed]) -> Table:
    table = Table(title="unseen half of the families: nm", title_justify="left", box=None, pad_edge=False)
    for head in ("scheme", "surface", "nights", "late RMS", "max", "known RMS", "unmatched", "lost"):
        table.add_column(head)
    for surface in SURFACES:
        for scheme in (OURS, ORACLE):
            here = [one for one in nights if (one.scheme, one.surface) == (scheme, surface)]
            table.add_row(scheme, surface, str(len(here)), *_figures(here))
    return table


def _unseen_rows(nights: Sequence[Followed]) -> Iterator[Row]:
    # late misplacement over the oracle's
    ratios = []
    for surface in SURFACES:
        own, oracle = (
            _late_m([one for one in nights if (one.scheme, one.surface) == (scheme, surface)])
            for scheme in (OURS, ORACLE)
        )
        ratios.append(own / oracle)
    yield Row("unseen nights: late misplacement over the oracle's, mean", "1", float(np.mean(ratios)), None, 1.15)
    yield Row("unseen nights: the same, worst surface", "1", max(ratios), None, 1.4)
    lost = sum(one.lost_at_end for one in nights if one.scheme == OURS)
    yield Row("unseen nights: lost for good", "nights", lost, None, 0)


def _wandering_rows(nights: Sequence[Followed]) -> Iterator[Row]:
    name = f"nights whose lines wander by {WANDER_PX} px"
    yield Row(f"{name}: chi² of the known drift, worst", "1", max(one.chi2 for one in nights), None, 2.0)
    yield Row(f"{name}: late misplacement", "nm", 1e9 * _late_m(nights), None, 4.5)


def _chi2(mistaken_m: NDArray[np.float64], covariances_m2: Sequence[NDArray[np.float64]]) -> float:
    apart = mistaken_m - mistaken_m.mean(axis=0)
    return float(np.mean([off @ np.linalg.solve(c, off) for off, c in zip(apart, covariances_m2, strict=True)])) / 2


def _figures(here: Sequence[Followed]) -> list[str]:
    late = np.concatenate([one.misplaced_m[LATE:] for one in here])
    most_m = float(np.linalg.norm(late, axis=1).max())
    known_m = _rms_m(one.mistaken_m[LATE:] for one in here)
    numbers = [f"{value * 1e9:.2f}" for value in (_late_m(here), most_m, known_m)]
    return [*numbers, str(sum(one.unmatched for one in here)), str(sum(one.lost for one in here))]


def _rows(nights: Sequence[Followed], starts: Sequence[Followed], long: Followed) -> Iterator[Row]:
    def late_nm(scheme: str) -> float:
        return 1e9 * _late_m([one for one in nights if one.scheme == scheme])

    yield Row("tracking: late misplacement, beside the oracle", "nm", late_nm(OURS), late_nm(ORACLE), 1.1)
    if any(one.scheme == FEATURES for one in nights):
        yield Row("tracking: beside the paper's scheme and BRIEF", "nm", late_nm(OURS), late_nm(FEATURES), 0.33)
    last_px = _rms_m([long.mistaken_m[-20:]]) / PIXEL_M
    yield Row(f"tracking: error after {len(long.misplaced_m)} scans", "px", last_px, None, 0.03)
    jump_nm = 1e9 * _jump_m([one for one in starts if one.scheme == OURS])
    yield Row("tracking: first jump", "nm", jump_nm, None, 30.0)


def _late_m(here: Sequence[Followed]) -> float:
    return _rms_m(one.misplaced_m[LATE:] for one in here)


def _jump_m(starts: Sequence[Followed]) -> float:
    return _rms_m(one.misplaced_m[1:2] for one in starts)


def _rms_m(parts: Iterable[NDArray[np.float64]]) -> float:
    # of the distances in arrays (n, 2)
    found = np.concatenate(list(parts))
    return math.sqrt(float(np.mean(np.sum(found**2, axis=1)))) if len(found) else math.nan
