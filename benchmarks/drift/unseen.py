"""Accuracy on families of pairs, on the half used for tuning and on the half that no tuning has seen."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from rich.table import Table

from benchmarks.drift import cuts
from benchmarks.drift.families import HALVES, Half, source
from benchmarks.drift.pairs import Sampling
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import Cell, Outcome, Trial, geometric_mean
from benchmarks.rows import Row

# Pairs of each surface in each half. The prior of pairs that have nothing in common is that of a tracker gone wrong.
PAIRS = {
    "white30": 24, "real": 96, "real+prior": 48, "hard": 48, "hard+prior": 48, "null": 48, "null+prior": 48,
    "zoom+prior": 48, "null-zoom+prior": 48,
}  # fmt: skip
# by the conditions under which they are taken
ZOOMS = {"zoom": "real", "null-zoom": "null", "zoom-wander": "real-wander"}
ZOOM_PX = (10.0, 30.0)  # of the overview
PRIOR_SD_PX = 1.5
GAP = 1.25  # of the unseen half over the fitted one, beyond which something was learnt by heart


def surfaces() -> tuple[str, ...]:
    """Return the families; images of real microscopes only where there are any."""
    return (*SURFACES, *((cuts.SURFACE,) if cuts.there_are_images() else ()))


def trials(half: Half, seeds: Mapping[str, Sequence[int]], estimators: tuple[str, ...]) -> list[Trial]:
    """Return the pairs of one half, by cell."""
    found = []
    for cell, numbers in seeds.items():
        name, _, prior = cell.partition("+")
        condition, sd_px = ZOOMS.get(name, name), PRIOR_SD_PX if prior else None
        for surface in surfaces() if name == condition else SURFACES:
            for seed in numbers:
                samplings = None if name == condition else _zoom(half, seed)
                found.append(
                    Trial(cell, surface, condition, seed, estimators, samplings=samplings, prior_sd_px=sd_px, half=half)
                )
    return found


def _zoom(half: Half, seed: int) -> tuple[Sampling, Sampling]:
    # an overview, and a zoom with pixels of its own
    random = source(half, seed, 31)
    pixels = int(random.choice((64, 96, 128)))
    return Sampling.square(128), Sampling.square(pixels, random.uniform(*ZOOM_PX) / (pixels - 1))


def jobs(plan: Plan) -> list[Trial]:
    seeds = {cell: plan.seeds(count) for cell, count in PAIRS.items()}
    return [job for half in HALVES for job in trials(half, seeds, (plan.ours,))]


def report(plan: Plan, results: Sequence[Outcome]) -> Report:
    cells = {
        (half, cell, surface): Cell.of(o for o in results if (o.half, o.cell, o.surface) == (half, cell, surface))
        for half in HALVES
        for cell in PAIRS
        for surface in surfaces()
    }
    return Report([_table(cells)], list(_rows(cells)))


Cells = Mapping[tuple[Half, str, str], Cell]


def _table(cells: Cells) -> Table:
    # one line per condition and surface: the fitted half / the unseen one
    table = Table(title="families: fitted / unseen", title_justify="left", box=None, pad_edge=False)
    for head in ("", "surface", "n", "RMS px", "ratio to Cb", "failed", "accepted", "right accepted", "wrong", "95 %"):
        table.add_column(head, justify="left" if head in ("", "surface") else "right", no_wrap=True)
    for cell in PAIRS:
        for surface in surfaces():
            if cell.partition("+")[0] in ZOOMS and surface not in SURFACES:
                continue
            both = [cells[half, cell, surface] for half in HALVES]
            table.add_row(
                cell, surface, str(both[1].count), _both(both, "rms_px", ".4f"), _both(both, "ratio", ".2f"),
                _both(both, "failed", ".0%"), _both(both, "accepted", ".0%"), _both(both, "right_accepted", ".0%"),
                _both(both, "wrong", ".1%"), _both(both, "covered", ".0%"),
                end_section=surface == surfaces()[-1],
            )  # fmt: skip
    return table


def _both(cells: Sequence[Cell], name: str, form: str) -> str:
    return " / ".join(format(getattr(cell, name), form) for cell in cells)


def _rows(cells: Cells) -> Iterator[Row]:
    # targets, on the unseen half

    def of(cell: str, half: Half = "unseen") -> dict[str, Cell]:
        return {surface: cells[half, cell, surface] for surface in surfaces()}

    def mean_ratio(cell: str, half: Half) -> float:
        return geometric_mean(cells[half, cell, surface].ratio for surface in SURFACES)

    for cell, target in (("white30", 1.3), ("real", 1.3)):
        yield Row(f"unseen {cell}: RMS over Cb, geometric mean", "1", mean_ratio(cell, "unseen"), None, target)
    yield Row("unseen real: the surface furthest from Cb", "1", max(of("real")[s].ratio for s in SURFACES), None, 2.0)
    gap = mean_ratio("real", "unseen") / mean_ratio("real", "fitted")
    yield Row("real: RMS over Cb, unseen over fitted", "1", gap, None, GAP)
    for cell, target in (("real", 95), ("real+prior", 95), ("hard", 85), ("hard+prior", 90)):
        least = 100 * min(c.right_accepted for c in of(cell).values())
        every = list(of(cell).values())
        mean = 100 * sum(c.right_accepted for c in every) / len(every)
        yield Row(f"unseen {cell}: right ones accepted", "%", mean, None, target, "high")
        yield Row(f"unseen {cell}: right ones accepted, worst surface", "%", least, None, target, "high")
    wrong = [c for cell in PAIRS for c in of(cell).values() if c.count]
    share = sum(c.wrong * c.count for c in wrong) / sum(c.accepted * c.count for c in wrong)
    yield Row("unseen: wrong among accepted", "%", 100 * share, None, 0.5)
    for cell in ("null", "null+prior", "null-zoom+prior"):
        most = 100 * max(c.wrong for c in of(cell).values() if c.count)
        yield Row(f"unseen {cell}: accepted, worst surface", "%", most, None, 2)
    for cell in ("real", "real+prior", "hard", "hard+prior"):
        covered = [100 * c.covered for c in of(cell).values() if not math.isnan(c.covered)]
        yield Row(f"unseen {cell}: 95 % ellipse covers, lowest", "%", min(covered), None, 90, "high")
        yield Row(f"unseen {cell}: 95 % ellipse covers, highest", "%", max(covered), None, 98)
    far = sum(c.beyond_three for c in wrong)
    yield Row("unseen: accepted, further off than three ellipses", "pairs", far, None, 0)
