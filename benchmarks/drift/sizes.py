"""Larger and smaller scans, pairs of different resolution, and the cost of an estimate."""

from __future__ import annotations

import math
import statistics
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence

from rich.table import Table

from afspm.plugins.drift.estimators import unguarded
from benchmarks.drift.pairs import Sampling, pair
from benchmarks.drift.parts import Plan, Report
from benchmarks.drift.surfaces import SURFACES
from benchmarks.drift.trials import Cell, Outcome, Trial
from benchmarks.rows import Row

SIZES = {512: 3, 256: 8, 64: 16}  # pixels, and pairs of each surface
# Pixels and their distance of the second scan; the first has 128, 1 apart.
MIXED = {"256 at 0.5": (256, 0.5), "256 at 1": (256, 1.0), "160 at 0.8": (160, 0.8), "64 at 2": (64, 2.0),
         "128 at 0.5": (128, 0.5)}  # fmt: skip
MIXED_PAIRS = 5
COSTS = {128: (3, 100), 256: (2, 250), 512: (1, 1100)}  # pixels: runs of each surface, ms at most
MEMORY_MB = 500
# Pixels, their distance, and the largest time over that of phase correlation, where tip and feedback blur the features.
OVERSAMPLED = {256: (0.35, 20), 512: (0.25, 25), 1024: (0.125, 30)}


def jobs(plan: Plan) -> list[Trial]:
    found = []
    for size, count in SIZES.items():
        for surface in SURFACES:
            names = plan.estimators if size < 256 else (plan.ours,)
            found += [Trial(str(size), surface, "real", seed, names, size) for seed in plan.seeds(count)]
    for cell, (size, step) in MIXED.items():
        samplings = (Sampling.square(128), Sampling.square(size, step))
        for surface in SURFACES:
            for seed in plan.seeds(MIXED_PAIRS):
                found.append(Trial(cell, surface, "real", seed, plan.estimators, samplings=samplings))
    return found


def report(plan: Plan, results: Sequence[Outcome]) -> Report:
    table = Table(title="real: sizes, and 128 px against others", title_justify="left", box=None, pad_edge=False)
    for head in ("", "estimator", "n", "RMS px", "median", "Cb", "failed", "accepted", "wrong", "ms"):
        table.add_column(head)
    for cell in (*map(str, SIZES), *MIXED):
        for name in plan.estimators:
            here = [o for o in results if (o.cell, o.estimator) == (cell, name)]
            if here:
                c = Cell.of(here)
                median = statistics.median(o.off_px if math.isfinite(o.off_px) else math.inf for o in here)
                table.add_row(
                    cell, name, str(c.count), f"{c.rms_px:.4f}", f"{median:.4f}", f"{c.bound_px:.4f}",
                    f"{c.failed:.0%}", f"{c.accepted:.0%}", f"{c.wrong:.0%}", f"{c.ms:.0f}",
                )  # fmt: skip
    return Report([table])


def costs(plan: Plan) -> Iterator[Row]:
    """Measure time and memory of the default estimator, in this process, with nothing else at the same time."""
    for size, (runs, target_ms) in COSTS.items():
        seeds = range(plan.seed, plan.seed + (1 if plan.quick else runs))
        times = [Trial("", s, "real", seed, (plan.ours,), size).run()[0].cpu_s for s in SURFACES for seed in seeds]
        yield Row(f"{size} px: an estimate", "ms", 1e3 * statistics.median(times), None, target_ms)
    yield from _beside_phase_correlation(plan)
    made = pair("rough", "real", plan.seed, 512)
    register = unguarded(plan.ours).register
    tracemalloc.start()
    register(made.reference, made.scan, None)
    peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    yield Row("512 px: memory of an estimate at its peak", "MB", peak_mb, None, MEMORY_MB)


def _beside_phase_correlation(plan: Plan) -> Iterator[Row]:
    # scikit-image's, to a twentieth of a pixel; each in turn, so that both meet the same load
    from skimage.registration import phase_cross_correlation

    correlated: Callable[..., object] = phase_cross_correlation
    register = unguarded(plan.ours).register
    for size, (step_px, most) in OVERSAMPLED.items():
        ours_s, bare_s = list[float](), list[float]()
        for surface in SURFACES:
            made = pair(surface, "real", plan.seed, samplings=(Sampling.square(size, step_px),) * 2)
            began_s = time.process_time()
            correlated(made.reference.values, made.scan.values, upsample_factor=20)
            between_s = time.process_time()
            register(made.reference, made.scan, None)
            ours_s.append(time.process_time() - between_s)
            bare_s.append(between_s - began_s)
        ours_ms, bare_ms = (1e3 * statistics.median(times) for times in (ours_s, bare_s))
        yield Row(f"{size} px, oversampled: an estimate, beside phase correlation", "ms", ours_ms, bare_ms, most)
