"""How well drift is followed through simulated nights: misplacement of the scans, and what errors add up to.

All is told relative to the first scan. "Late" is from the ninth scan on, two hours after the start. The oracle knows
the true drift of all scans so far and predicts with the same filters: what is left is what nobody can foresee.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from afspm.drift.estimators import estimator
from afspm.drift.trackers import tracker
from afspm.drift.tracking import Tracker
from benchmarks.drift.nights import Night, Oracle
from benchmarks.drift.pairs import PIXEL_M
from benchmarks.drift.parts import Plan, Report
from benchmarks.rows import Row

SCANS = 32
LATE = 8
NIGHTS = {"rough": 3, "particles": 1, "steps": 1, "stamper": 1}
# A thousand would take longer than all the rest. If errors added up, they would grow with the root of the number.
LONG_SCANS = 200
LONG_REFERENCES = 2
STARTS = {"rough": 6, "stamper": 4}

OURS, ORACLE, PAPER, FEATURES = "bank", "oracle, bank", "paper's scheme", "paper's scheme, brief"
FIRST_ORDER, STARTED, LONG = "oracle, paper's scheme", "bank, up and down", "bank, long"


@dataclass(frozen=True)
class Followed:
    """What came of one night; all in m, (scans, 2) flattened.

    Attributes:
        misplaced: predicted less true position of each scan.
        mistaken: believed less true position after it.
        unmatched, lost: how many scans were so.
    """

    scheme: str
    surface: str
    misplaced: tuple[float, ...]
    mistaken: tuple[float, ...]
    unmatched: int
    lost: int

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

    def run(self) -> list[Followed]:
        night = Night(self.surface, self.seed, self.scans)
        misplaced, mistaken, unmatched, lost = [], [], 0, 0
        for drift_m, update in night.followed(self._tracker(night), up_and_down=self.scheme == STARTED):
            misplaced += list(-update.before.mapping.translation_m - drift_m)
            mistaken += list(-update.after.mapping.translation_m - drift_m)
            unmatched += not update.matched
            lost += update.lost
        return [Followed(self.scheme, self.surface, tuple(misplaced), tuple(mistaken), unmatched, lost)]

    def _tracker(self, night: Night) -> Tracker:
        kind = "paper" if self.scheme in (PAPER, FEATURES, FIRST_ORDER) else "bank"
        if self.scheme in (ORACLE, FIRST_ORDER):
            return tracker({"class": kind, **({"compared": 1} if kind == "bank" else {})}, Oracle(night.drift))
        settings = {"compared": LONG_REFERENCES} if self.scheme == LONG else {}
        return tracker({"class": kind, **settings}, estimator(self.estimator))


def jobs(plan: Plan) -> list[Track]:
    scans = SCANS // 2 if plan.quick else SCANS
    found = [Track(LONG, "rough", plan.seed, LONG_SCANS // 8 if plan.quick else LONG_SCANS, plan.ours)]
    schemes = [(OURS, plan.ours), (ORACLE, ""), (FIRST_ORDER, ""), (PAPER, plan.ours)]
    if "brief" in plan.estimators:
        schemes.append((FEATURES, "brief"))
    for surface, count in NIGHTS.items():
        for seed in range(plan.seed, plan.seed + (1 if plan.quick else count)):
            found += [Track(scheme, surface, seed, scans, name) for scheme, name in schemes]
    for surface, count in STARTS.items():
        for seed in plan.seeds(count):
            found += [Track(scheme, surface, seed + 500, 2, plan.ours) for scheme in (OURS, STARTED)]
    return found


def report(plan: Plan, results: Sequence[Followed]) -> Report:
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
    for scheme in (OURS, STARTED):
        first = [one for one in starts if one.scheme == scheme]
        table.add_row(f"{scheme}: first jump", "rough, stamper", str(len(first)), f"{_jump_m(first) * 1e9:.1f}")
    return Report([table], list(_rows(nights, starts, long)))


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
    jump_nm = 1e9 * _jump_m([one for one in starts if one.scheme == STARTED])
    yield Row("tracking: first jump, after up and down", "nm", jump_nm, None, 30.0)


def _late_m(here: Sequence[Followed]) -> float:
    return _rms_m(one.misplaced_m[LATE:] for one in here)


def _jump_m(starts: Sequence[Followed]) -> float:
    return _rms_m(one.misplaced_m[1:2] for one in starts)


def _rms_m(parts: Iterable[NDArray[np.float64]]) -> float:
    """Of the distances in arrays (n, 2)."""
    found = np.concatenate(list(parts))
    return math.sqrt(float(np.mean(np.sum(found**2, axis=1)))) if len(found) else math.nan
