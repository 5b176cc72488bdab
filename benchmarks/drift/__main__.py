"""`python -m benchmarks.drift`: accuracy of drift estimation, beside the bound and the methods of features.

Prints tables, writes build/bench-drift.json (the lines with a target, in the form of build/bench.json) and
build/bench-drift.txt (all printed text). Returns 1 if a target was missed; with `--quick` it judges the targets that
allow no pair at all, since an eighth of the pairs proves a miss of these alone.

Beside each line stands its value in the last landed run of all pairs (benchmarks/drift/landed.json), which `--land`
replaces: so a change shows its cost, also where the target is missed as before.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import secrets
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

# Before numpy starts its own threads: the cores are shared out by pairs.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

from rich.console import Console
from rich.table import Table

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
from afspm.plugins.drift.estimators import DEFAULT
from afspm.plugins.drift.estimators import estimator as estimator_named
from benchmarks.drift import cuts, sizes
from benchmarks.drift.parts import Plan
from benchmarks.drift.workers import done
from benchmarks.rows import Row

PARTS = ("tracks", "sizes", "accuracy", "unseen", "independent")  # the longest jobs first
ON_REQUEST = ("inliers",)  # of the paper's method, without a target
RESULT = Path("build/bench-drift.json")
LANDED = Path(__file__).with_name("landed.json")
NAMES = entry_points.names(entry_points.ESTIMATORS)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = _parser()
    asked = parser.parse_args(arguments)
    if asked.land and asked.quick:
        parser.error("an eighth of the pairs can't be landed")
    before = json.loads(LANDED.read_text(encoding="utf-8")) if LANDED.exists() else {}
    console = Console(record=True, width=140, highlight=False)
    plan = Plan(asked.seed, asked.quick, _available(asked.estimators, console))
    began_s = time.perf_counter()
    modules = [(n, importlib.import_module(f"benchmarks.drift.{n}")) for n in asked.parts]
    lists = [module.jobs(plan) for _, module in modules]
    results = done([job for jobs in lists for job in jobs], asked.processes)
    rows: list[Row] = []
    for (_, module), jobs in zip(modules, lists, strict=True):
        report = module.report(plan, [one for job in jobs for one in results[job]])
        rows += report.rows
        for table in report.tables:
            console.print(table, "")
    if "sizes" in asked.parts:
        rows += sizes.costs(plan)
    judged = [row for row in rows if not plan.quick or row.target == 0.0]
    console.print(_targets(rows, judged, before))
    # images are the hardest surface of the families: without them more of the right ones are accepted
    images = "with" if cuts.there_are_images() else "without"
    eighth = ", an eighth of the pairs" * plan.quick
    used = os.times()  # of this process and its workers, which have ended
    cpu_s = used.user + used.system + used.children_user + used.children_system
    console.print(
        f"seed {plan.seed}{eighth}, {images} real images; {time.perf_counter() - began_s:.0f} s, "
        f"{cpu_s:.0f} s of processor, load {os.getloadavg()[2]:.1f}"
    )
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps([row.to_json() for row in rows], indent=1) + "\n", encoding="utf-8")
    RESULT.with_suffix(".txt").write_text(console.export_text(), encoding="utf-8")
    if asked.land:
        found = {**before, **{row.name: float(f"{row.ratio:.4g}") for row in rows}}
        LANDED.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    return 0 if all(row.met for row in judged) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift", description=__doc__)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10**6) * 1000, help="default: a fresh one")
    parser.add_argument("--quick", action="store_true", help="an eighth of the pairs, for targets of no pair")
    parser.add_argument("--land", action="store_true", help="keep the values, to compare later runs with")
    parser.add_argument("--parts", nargs="+", choices=(*PARTS, *ON_REQUEST), default=list(PARTS))
    parser.add_argument("--estimators", nargs="+", default=[DEFAULT, *(n for n in NAMES if n != DEFAULT)],
                        help="names; the first is held against the targets")  # fmt: skip
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    return parser


def _available(names: Sequence[str], console: Console) -> tuple[str, ...]:
    # the first one is under test, so it must be available
    estimator_named(names[0])
    found = [names[0]]
    for name in names[1:]:
        try:
            estimator_named(name)
        except ConfigError as error:
            console.print(f"without {name}: {error}")
        else:
            found.append(name)
    return tuple(found)


def _targets(rows: Sequence[Row], judged: Sequence[Row], before: Mapping[str, float]) -> Table:
    table = Table(title="targets", title_justify="left", box=None, pad_edge=False)
    for head in ("", "ours", "beside", "ratio", "landed", "target", ""):
        table.add_column(head, justify="left" if not head else "right")
    for row in rows:
        sign = "<=" if row.better == "low" else ">="
        bare = "" if row.bare is None else f"{row.bare:.4g}"
        mark = "" if row not in judged else "[green]met[/]" if row.met else "[red]MISSED[/]"
        ratio = "" if row.bare is None else f"{row.ratio:.2f}"
        landed = f"{before[row.name]:.4g}" if row.name in before else ""
        name = f"{row.name} \\[{row.unit}]"
        table.add_row(name, f"{row.ours:.4g}", bare, ratio, landed, f"{sign} {row.target:g}", mark)
    return table


if __name__ == "__main__":
    sys.exit(main())
