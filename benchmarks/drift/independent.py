"""Accuracy of the default estimator on pairs of a second generator, `foreign_pairs`, to which nothing is fitted."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from afspm.plugins.drift.estimators.least_squares import LeastSquares
from benchmarks.drift.foreign_pairs import CELLS, PIXEL_M, SURFACES, WANDERING, ZOOMS, foreign_pair
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.trials import ELLIPSE_95, Cell, Outcome, geometric_mean
from benchmarks.rows import Row

PAIRS = (
    {"real": 80, "hard": 40, "hard+prior": 40, "turned": 30, "null": 40, "null+prior": 40}
    | {f"zoom{px}": 30 for px in ZOOMS}
    | dict.fromkeys(WANDERING, 24)
)
RIGHT_ZOOMS = {13: 65, 16: 88, 20: 90, 24: 92}  # %, accepted


@dataclass(frozen=True)
class ForeignTrial:
    """A job: one pair, registered by the default estimator without its guard."""

    cell: str
    surface: str
    seed: int

    def run(self) -> list[Outcome]:
        made = foreign_pair(self.cell, self.surface, self.seed)
        began_s = time.process_time()
        found = LeastSquares().register(made.reference, made.scan, made.prior)
        cpu_s = time.process_time() - began_s
        error, chi2 = (np.nan, np.nan), np.nan
        if not made.elsewhere and np.isfinite(found.displacement_m).all():
            center_m = PIXEL_M * made.center_px
            there_m = found.displacement_m + found.linear @ (center_m - found.center_m)
            x, y = there_m / PIXEL_M - made.displacement_px
            error = (float(x), float(y))
            own = found.displacement_m - made.displacement_m(found.center_m)
            chi2 = float(own @ np.linalg.solve(found.covariance_m2, own))
        return [
            Outcome(
                cell=self.cell,
                surface=self.surface,
                estimator="least-squares",
                seed=self.seed,
                accepted=found.accepted,
                reason=found.reason,
                error_px=error,
                chi2=chi2,
                bound_px=made.bound_px,
                white_bound_px=np.nan,
                cpu_s=cpu_s,
                quality=dict(found.quality),
            )
        ]


def jobs(plan: Plan) -> list[ForeignTrial]:
    return [
        ForeignTrial(cell, surface, seed) for cell in CELLS for surface in SURFACES for seed in plan.seeds(PAIRS[cell])
    ]


def report(plan: Plan, results: Sequence[Outcome]) -> Report:
    cells = {
        (cell, surface): Cell.of(o for o in results if (o.cell, o.surface) == (cell, surface))
        for cell in PAIRS
        for surface in SURFACES
    }
    return Report([_table(cells), _ellipses(results)], list(_rows(cells)))


Cells = dict[tuple[str, str], Cell]


def _table(cells: Cells) -> Table:
    table = Table(title="pairs of the second generator", title_justify="left", box=None, pad_edge=False)
    heads = ("", "surface", "n", "RMS px", "ratio to Cb", "failed", "accepted", "right accepted", "wrong", "95 %", "ms")
    for head in heads:
        table.add_column(head, justify="left" if head in ("", "surface") else "right", no_wrap=True)
    for (cell, surface), c in cells.items():
        table.add_row(
            cell, surface, str(c.count), f"{c.rms_px:.4f}", f"{c.ratio:.2f}", f"{c.failed:.0%}", f"{c.accepted:.0%}",
            f"{c.right_accepted:.0%}", f"{c.wrong:.1%}", f"{c.covered:.0%}", f"{c.ms:.0f}",
            end_section=surface == list(SURFACES)[-1],
        )  # fmt: skip
    return table


def _ellipses(results: Sequence[Outcome]) -> Table:
    # Of all surfaces together. "before": with the factor of the evidence, which was fitted to pairs without wander.
    table = Table(title="ellipses of accepted pairs that are not wrong", title_justify="left", box=None, pad_edge=False)
    for head in ("", "accepted", "chi2 before", "chi2", "95 % before", "95 %", "sd over before"):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)
    for cell in PAIRS:
        every = [o for o in results if o.cell == cell]
        sure = [o for o in every if o.accepted and not o.failed]
        if not sure:
            continue
        now = np.array([o.chi2 for o in sure])
        wider = np.array([o.quality["spread"] / o.quality["spread_of_evidence"] for o in sure])
        table.add_row(
            cell, f"{len(sure)} of {len(every)}", f"{np.mean(now * wider) / 2:.2f}", f"{np.mean(now) / 2:.2f}",
            f"{np.mean(now * wider <= ELLIPSE_95):.0%}", f"{np.mean(now <= ELLIPSE_95):.0%}",
            f"{np.exp(np.mean(np.log(wider)) / 2):.2f}",
        )  # fmt: skip
    return table


def _rows(cells: Cells) -> Iterator[Row]:
    def of(cell: str) -> list[Cell]:
        return [cells[cell, surface] for surface in SURFACES]

    def share(cell: str) -> float:
        # accepted ones among the right ones, %
        right = sum((1.0 - c.failed) * c.count for c in of(cell))
        return 100 * sum((c.accepted - c.wrong) * c.count for c in of(cell)) / max(right, 1.0)

    yield Row("second generator, real: RMS over Cb", "1", geometric_mean(c.ratio for c in of("real")), None, 1.45)
    yield Row("second generator, real: stamper, RMS over Cb", "1", cells["real", "stamper"].ratio, None, 2.2)
    for cell, target in (("real", 95), ("hard", 80), ("hard+prior", 88)):
        yield Row(f"second generator, {cell}: right ones accepted", "%", share(cell), None, target, "high")
    for px, target in RIGHT_ZOOMS.items():
        yield Row(
            f"second generator, zooms of {px} px: right ones accepted", "%", share(f"zoom{px}"), None, target, "high"
        )
    every = list(cells.values())
    wrong = 100 * sum(c.wrong * c.count for c in every) / max(sum(c.accepted * c.count for c in every), 1.0)
    yield Row("second generator: wrong among accepted", "%", wrong, None, 0.5)
    for cell in PAIRS:
        if not cell.startswith("null"):
            accepted = sum(c.accepted * c.count for c in of(cell))
            held = sum(c.covered * c.accepted * c.count for c in of(cell) if c.accepted)
            yield Row(
                f"second generator, {cell}: 95 % ellipse covers", "%", 100 * held / max(accepted, 1.0), None, 90, "high"
            )
