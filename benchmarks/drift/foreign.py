"""`python -m benchmarks.drift.foreign FOLDER`: judge the default estimator on pairs of frames made by another program.

The folder holds `NNN.npz` (`first`, `second`, `pixel_nm_x`, `pixel_nm_y`, `line_time_s`, `second_starts_at_line_times`
if known) and `NNN.truth.json`: for each row the displacement of the sample in px (`dx_first`, … `dy_second`; null for
unmeasured rows), `condition`, `kind`, `related`. The truth of a pair is the mean displacement over the rows of the
overlap, since this is the quantity whose covariance a registration states.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"

import numpy as np
from rich.console import Console
from rich.table import Table

from afspm.components import Array
from afspm.model import Region
from afspm.plugins.drift.estimators.least_squares import LeastSquares
from afspm.plugins.drift.registration import DriftScan
from benchmarks.drift.trials import ELLIPSE_95, FAILED_PX
from benchmarks.drift.workers import done


@dataclass(frozen=True)
class Judged:
    """The result of a pair: error (x, y), its standard deviations and chi2, in px; NaN without a truth or estimate."""

    condition: str
    kind: str
    name: str
    accepted: bool
    reason: str
    error_px: tuple[float, float]
    sd_px: tuple[float, float]
    chi2: float
    cpu_s: float

    @property
    def right(self) -> bool:
        return math.hypot(*self.error_px) <= FAILED_PX


@dataclass(frozen=True)
class FolderTrial:
    """A job: one pair of a folder, registered without a prior."""

    path: Path

    def run(self) -> list[Judged]:
        truth = json.loads(self.path.with_suffix(".truth.json").read_text(encoding="utf-8"))
        with np.load(self.path) as file:
            data = {name: np.asarray(file[name], dtype=np.float64) for name in file.files}
        pixel_m = np.array([data["pixel_nm_x"], data["pixel_nm_y"]]) * 1e-9
        first, second = (_scan(data, name, pixel_m) for name in ("first", "second"))
        began_s = time.process_time()
        found = LeastSquares().register(first, second)
        cpu_s = time.process_time() - began_s
        error, sd, chi2 = (math.nan, math.nan), (math.nan, math.nan), math.nan
        if np.isfinite(found.displacement_m).all():
            covariance = found.covariance_m2 / np.outer(pixel_m, pixel_m)
            sd = tuple(np.sqrt(np.diag(covariance)).tolist())
            if truth["related"]:
                off = found.displacement_m / pixel_m - _true_px(truth, found.center_m / pixel_m)
                error, chi2 = tuple(off.tolist()), float(off @ np.linalg.solve(covariance, off))
        return [
            Judged(
                truth["condition"], truth["kind"], self.path.stem, found.accepted, found.reason, error, sd, chi2, cpu_s
            )
        ]


def _scan(data: dict[str, Array], name: str, pixel_m: Array) -> DriftScan:
    values = data[name]
    rows, columns = values.shape
    start_s = (
        0.0 if name == "first" else float(data.get("second_starts_at_line_times", 2.0 * rows) * data["line_time_s"])
    )
    region = Region((0.0, 0.0), tuple((pixel_m * (columns - 1, rows - 1)).tolist()))
    return DriftScan(values, region, start_s, start_s + rows * float(data["line_time_s"]), upwards=True, key=name)


def _true_px(truth: dict[str, Any], at_px: Array) -> Array:
    # at a position of the first frame, from its middle
    first, second = (_rows(truth, name) for name in ("first", "second"))
    r = np.arange(first.shape[1], dtype=np.float64)
    moved = np.array(truth["mean_difference"])[:, None] + np.zeros_like(first)
    for _ in range(10):  # a row of the first frame, and the rows of the second that show its features
        there = r + moved[1]
        moved = np.array([np.interp(there, r, one) for one in second]) - first
    shown = np.isfinite(moved).all(axis=0) & (there >= r[0]) & (there <= r[-1])
    mean = moved[:, shown].mean(axis=1)
    turn = math.radians(truth["parameters"].get("turned_deg", 0.0))
    turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    return np.asarray(mean + (turned - np.eye(2)) @ at_px)


def _rows(truth: dict[str, Any], name: str) -> Array:
    return np.array([[math.nan if d is None else d for d in truth[f"{axis}_{name}"]] for axis in ("dx", "dy")])


def table(found: Sequence[Judged], by: str) -> Table:
    """Return a table of figures by `condition` or `kind`."""
    heads = (
        "pairs",
        "right",
        "accepted",
        "of right",
        "wrong",
        "chi2 x",
        "chi2 y",
        "95 %",
        "rms x",
        "sd x",
        "rms y",
        "sd y",
    )
    made = Table(title=f"by {by}: px; figures of accepted pairs that are right", title_justify="left", box=None)
    for head in ("", *heads):
        made.add_column(head, justify="right" if head else "left", no_wrap=True)
    for name in (*sorted({getattr(one, by) for one in found}), "all"):
        here = [one for one in found if name in ("all", getattr(one, by))]
        right, sure = [o for o in here if o.right], [o for o in here if o.accepted]
        held = [o for o in sure if o.right]
        errors, sds = (np.array([getattr(o, which) for o in held]).reshape(-1, 2) for which in ("error_px", "sd_px"))
        figures = [""] * 7
        if held:
            chi2, rms, sd = (np.mean(each, axis=0) for each in ((errors / sds) ** 2, errors**2, sds**2))
            within = np.mean([o.chi2 <= ELLIPSE_95 for o in held])
            figures = [f"{chi2[0]:.2f}", f"{chi2[1]:.2f}", f"{within:.0%}"]
            figures += [f"{math.sqrt(each):.3f}" for axis in (0, 1) for each in (rms[axis], sd[axis])]
        share = f"{len(held) / len(right):.0%}" if right else ""
        counts = (len(here), len(right), len(sure), share, len(sure) - len(held))
        made.add_row(name, *map(str, counts), *figures)
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.drift.foreign", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--conditions", nargs="+", help="default: all")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    asked = parser.parse_args(arguments)
    paths = sorted(asked.folder.glob("*.npz"))
    if asked.conditions:
        paths = [path for path in paths if _condition(path) in asked.conditions]
    if not paths:
        parser.error(f"{asked.folder} holds no pairs NNN.npz of these conditions")
    began_s = time.perf_counter()
    found = [one for each in done([FolderTrial(path) for path in paths], asked.processes).values() for one in each]
    console = Console(width=150, highlight=False)
    console.print(table(found, "condition"), "", table(found, "kind"), "")
    for one in found:
        if one.accepted and not one.right:
            off = "unrelated" if math.isnan(one.error_px[0]) else f"{math.hypot(*one.error_px):.2f} px off"
            console.print(
                f"accepted and wrong: {one.name} ({one.kind}, {one.condition}): {off}, sd {max(one.sd_px):.2f} px"
            )
    console.print(
        f"{len(found)} pairs of {asked.folder.name}; {np.median([o.cpu_s for o in found]):.2f} s of processor a pair, "
        f"{time.perf_counter() - began_s:.0f} s by {asked.processes} processes, load {os.getloadavg()[1]:.1f}, "
        f"Python {platform.python_version()}, numpy {np.__version__}"
    )
    return 0


def _condition(path: Path) -> str:
    return str(json.loads(path.with_suffix(".truth.json").read_text(encoding="utf-8"))["condition"])


if __name__ == "__main__":
    raise SystemExit(main())
