"""Errors of estimates over the bound, on every surface under every condition, beside the methods of features."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence

from rich.table import Table

from benchmarks.drift.bounds import unknown_rough
from benchmarks.drift.conditions import CONDITIONS
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import PUBLISHED, Cell, Outcome, Trial, geometric_mean
from benchmarks.rows import Row

# Pairs of each surface: of ours, and of those that there are to compare with. The paper's as published is fast, and has
# all of one cell.
PAIRS = {
    "white100": (12, 0),
    "white30": (40, 10),
    "white10": (12, 0),
    "white3": (12, 6),
    "flat30": (40, 10),
    "real": (150, 12),
    "hard": (50, 10),
    "hard+prior": (50, 0),
    "dtip": (12, 0),
}
WITH_PUBLISHED = "real"
PRIOR_SD_PX = 1.5
LIKE_REAL = {"stamper": 0.06, "rough": 0.012, "particles": 0.015, "lattice": 0.005, "steps": 0.045}
EASY_WHEN_HARD = ("rough", "particles", "lattice")


def jobs(plan: Plan) -> list[Trial]:
    found = []
    for cell, (own, others) in PAIRS.items():
        condition, _, prior = cell.partition("+")
        compared = len(plan.seeds(others)) if others else 0
        for surface in SURFACES:
            for k, seed in enumerate(plan.seeds(own)):
                names = plan.estimators if k < compared else plan.estimators[:1]
                if cell == WITH_PUBLISHED:
                    names = (*names, *_published(plan))
                sd_px = PRIOR_SD_PX if prior else None
                found.append(Trial(cell, surface, condition, seed, names, prior_sd_px=sd_px))
    return found


def _published(plan: Plan) -> tuple[str, ...]:
    # it needs the library of the methods of features
    return (PUBLISHED,) if "brief" in plan.estimators else ()


def report(plan: Plan, results: Sequence[Outcome]) -> Report:
    mine = [o for o in results if o.estimator == plan.ours]
    own = {
        (cell, surface): Cell.of(o for o in mine if (o.cell, o.surface) == (cell, surface))
        for cell in PAIRS
        for surface in SURFACES
    }
    tables = [_own_table(plan.ours, own)]
    if len(plan.estimators) > 1:
        tables.append(_beside_table(plan, results))
    return Report(tables, [*_white_rows(own), *_real_rows(own), *_hard_rows(own), *_beside_rows(plan, results)])


def _own_table(name: str, own: dict[tuple[str, str], Cell]) -> Table:
    heads = "RMS px|p95|Cb|ratio|Cu|C|failed|accepted|wrong|bias x|bias y|95 %|ms"
    table = _table(f"{name}: errors at the middle of the overlap", f"|surface|n|{heads}")
    for (cell, surface), c in own.items():
        table.add_row(
            cell, surface, str(c.count), _px(c.rms_px), _px(c.p95_px), _px(c.bound_px), f"{c.ratio:.2f}",
            _unknown(cell, surface, c), _px(c.white_bound_px), f"{c.failed:.1%}", f"{c.accepted:.1%}", f"{c.wrong:.1%}",
            f"{c.bias_px[0]:+.4f}", f"{c.bias_px[1]:+.4f}", f"{c.covered:.0%}", f"{c.ms:.0f}",
            end_section=surface == list(SURFACES)[-1],
        )  # fmt: skip
    return table


def _unknown(cell: str, surface: str, figures: Cell) -> str:
    # Cu: the bound for a surface that must be learnt from the scans; known for a Gaussian one
    return _px(figures.bound_px * unknown_rough(CONDITIONS[cell.partition("+")[0]])) if surface == "rough" else ""


def _beside_table(plan: Plan, results: Sequence[Outcome]) -> Table:
    # one line per condition and estimator: geometric means over the surfaces, over the pairs given to all estimators
    table = _table("beside others, on the same pairs", "|estimator|n|RMS px|ratio to Cb|failed|accepted|wrong|ms")
    for cell in PAIRS:
        for name in (*plan.estimators, *(_published(plan) if cell == WITH_PUBLISHED else ())):
            shared = _shared(plan, results, cell)
            if not shared:
                continue
            each = [Cell.of(o for o in shared if (o.surface, o.estimator) == (s, name)) for s in SURFACES]
            every = Cell.of(o for o in shared if o.estimator == name)
            table.add_row(
                cell, name, str(every.count), _px(geometric_mean(c.rms_px for c in each)),
                f"{geometric_mean(c.ratio for c in each):.1f}", f"{every.failed:.0%}", f"{every.accepted:.0%}",
                f"{every.wrong:.0%}", f"{every.ms:.0f}",
            )  # fmt: skip
    return table


def _shared(plan: Plan, results: Sequence[Outcome], cell: str) -> list[Outcome]:
    # pairs given to every estimator; none if there is only one estimator
    seeds = {o.seed for o in results if o.cell == cell and o.estimator == plan.estimators[-1] != plan.ours}
    return [o for o in results if o.cell == cell and o.seed in seeds]


def _white_rows(own: dict[tuple[str, str], Cell]) -> Iterator[Row]:
    both = [c for (cell, _), c in own.items() if cell in ("white30", "flat30")]
    for cell in ("white30", "flat30"):
        yield _ratio_row(cell, own, 1.25)
        yield Row(f"{cell}: the surface furthest from Cb", "1", max(own[cell, s].ratio for s in SURFACES), None, 1.7)
    yield Row("white30, flat30: largest bias", "px", max(abs(b) for c in both for b in c.bias_px), None, 0.003)
    yield Row("white30, flat30: failed", "pairs", _pairs(both, "failed"), None, 0)


def _real_rows(own: dict[tuple[str, str], Cell]) -> Iterator[Row]:
    real = {surface: own["real", surface] for surface in SURFACES}
    yield _ratio_row("real", own, 1.25)
    for surface, target in LIKE_REAL.items():
        yield Row(f"real: {surface}, RMS", "px", real[surface].rms_px, None, target)
    yield Row("real: failed", "pairs", _pairs(real.values(), "failed"), None, 0)
    yield Row("real: accepted but wrong", "pairs", _pairs(real.values(), "wrong"), None, 0)
    yield Row("real: accepted", "%", 100 * _share(real.values(), "accepted"), None, 98, "high")
    covered = {surface: 100 * cell.covered for surface, cell in real.items()}
    stamper = covered.pop("stamper")
    yield Row("real: 95 % ellipse covers, lowest but stamper", "%", min(covered.values()), None, 90, "high")
    yield Row("real: 95 % ellipse covers, highest but stamper", "%", max(covered.values()), None, 98)
    yield Row("real: 95 % ellipse covers, stamper", "%", stamper, None, 80, "high")


def _hard_rows(own: dict[tuple[str, str], Cell]) -> Iterator[Row]:
    for surface in EASY_WHEN_HARD:
        cell = own["hard", surface]
        yield Row(f"hard: {surface}, RMS beside Cb", "px", cell.rms_px, cell.bound_px, 1.6)
    for name in ("hard", "hard+prior"):
        cells = [own[name, surface] for surface in SURFACES]
        if name != "hard":
            yield Row(f"{name}: failed", "%", 100 * _share(cells, "failed"), None, 2)
        yield Row(f"{name}: accepted but wrong", "%", 100 * _share(cells, "wrong"), None, 1)


def _beside_rows(plan: Plan, results: Sequence[Outcome]) -> Iterator[Row]:
    # on surfaces where both found anything, over all pairs
    here = [o for o in results if o.cell == WITH_PUBLISHED]
    pairs = [
        [Cell.of(o for o in here if (o.surface, o.estimator) == (s, name)).rms_px for name in (PUBLISHED, plan.ours)]
        for s in SURFACES
        if _published(plan)
    ]
    found = [each for each in pairs if all(map(math.isfinite, each))]
    if found:
        theirs, own = (geometric_mean(each) for each in zip(*found, strict=True))
        yield Row("real: RMS of the published brief beside ours", "px", theirs, own, 20, "high")


def _ratio_row(cell: str, own: dict[tuple[str, str], Cell], target: float) -> Row:
    each = [own[cell, surface] for surface in SURFACES]
    rms, bound = geometric_mean(c.rms_px for c in each), geometric_mean(c.bound_px for c in each)
    return Row(f"{cell}: RMS beside Cb, geometric mean", "px", rms, bound, target)


def _pairs(cells: Iterable[Cell], what: str) -> float:
    return float(sum(round(getattr(c, what) * c.count) for c in cells))


def _share(cells: Collection[Cell], what: str) -> float:
    return _pairs(cells, what) / sum(c.count for c in cells)


def _px(value: float) -> str:
    return f"{value:.4f}"


def _table(title: str, heads: str) -> Table:
    table = Table(title=title, title_justify="left", pad_edge=False, box=None, header_style="bold")
    for k, head in enumerate(heads.split("|")):
        table.add_column(head, justify="left" if k < 2 else "right", no_wrap=True)
    return table
