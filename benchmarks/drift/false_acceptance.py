"""How often scans that have nothing in common are said to fit: with what a tracker would expect, and without."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import Outcome, Trial
from benchmarks.rows import Row

CONDITIONS = ("null", "nullh")
PAIRS = 60
COMPARED = 10
PRIOR_SD_PX = 1.0


def jobs(plan: Plan) -> list[Trial]:
    found = []
    for condition in CONDITIONS:
        for surface in SURFACES:
            compared = set(plan.seeds(COMPARED))
            for seed in plan.seeds(PAIRS):
                names = plan.estimators if seed in compared else plan.estimators[:1]
                found.append(Trial(condition, surface, condition, seed, names))
                found.append(
                    Trial(f"{condition}+prior", surface, condition, seed, (plan.ours,), prior_sd_px=PRIOR_SD_PX)
                )
    return found


def report(plan: Plan, results: Sequence[Outcome]) -> Report:
    table = Table(title="accepted though nothing is in common, %", title_justify="left", box=None, pad_edge=False)
    for head in ("", "estimator", "n", *SURFACES):
        table.add_column(head)
    for cell in dict.fromkeys(o.cell for o in results):
        for name in plan.estimators:
            here = [o for o in results if (o.cell, o.estimator) == (cell, name)]
            if here:
                count = len(here) // len(SURFACES)
                table.add_row(cell, name, str(count), *(f"{_percent(here, s):.1f}" for s in SURFACES))
    own = [o for o in results if o.estimator == plan.ours]
    return Report([table], [row for condition in CONDITIONS for row in _rows(condition, own)])


def _rows(condition: str, own: Sequence[Outcome]) -> Iterator[Row]:
    """Without a prior any end of a bump fits another: the stamper is only in the table then."""
    informed = [o for o in own if o.cell == f"{condition}+prior"]
    blind = [o for o in own if o.cell == condition]
    most = max(_percent(informed, s) for s in SURFACES)
    yield Row(f"{condition}+prior: accepted, worst surface", "%", most, None, 0.5)
    most = max(_percent(blind, s) for s in SURFACES if s != "stamper")
    yield Row(f"{condition}: accepted, worst surface but stamper", "%", most, None, 2)


def _percent(outcomes: Sequence[Outcome], surface: str) -> float:
    here = [o.accepted for o in outcomes if o.surface == surface]
    return 100 * sum(here) / len(here)
