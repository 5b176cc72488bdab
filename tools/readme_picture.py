"""Draws the picture of the README, 830 px wide, from the last repair of a run: `python tools/readme_picture.py RUN`.

The run is that of `afspm demo`. Fonts are at least 11 px high at the width at which the README shows the picture.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from control_transfer import excerpt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from PIL import Image

import afspm
from afspm.drawing.palette import CATEGORICAL, PROBLEM
from afspm.drawing.plotting import gold

PICTURE: Final = Path(__file__).resolve().parents[1] / "docs" / "pictures" / "repair.png"
WIDTH_PX, HEIGHT_PX, DPI = 830, 390, 200
SHOWN: Final = 9
LANES: Final = ("tip-shape-changed", "tip_corrector", "series")
COLOURS: Final = dict(zip(LANES, (PROBLEM, CATEGORICAL[1], CATEGORICAL[0]), strict=True))
ROBUST: Final = (1.0, 99.5)


def draw(folder: Path) -> Figure:
    """Return scans around a repair, and below them the flag and the holder of control in time."""
    run, night = afspm.open_run(folder), excerpt(folder)
    figure = Figure(figsize=(WIDTH_PX / 100, HEIGHT_PX / 100), facecolor="white")
    times = figure.add_axes((0.165, 0.14, 0.82, 0.30))
    _lanes(times, night)
    flagged_ns = run.problems[-1].flagged_ns
    middle = next(k for k, (_, _, bad) in enumerate(night["scans"]) if bad)
    first = max(0, min(middle - 1, len(night["scans"]) - SHOWN))
    ends_s = {end_s: (begin_s, bad) for begin_s, end_s, bad in night["scans"][first : first + SHOWN]}
    rows = [row for row in run.scans if round((row.time_ns - flagged_ns) / 1e9, 1) in ends_s]
    values = [run.scan(row)["Height"].levelled(order=1, fit="huber").values for row in rows]
    low, high = np.percentile(values[0], ROBUST)  # one contrast for all: that of a good tip
    for place, (row, picture) in enumerate(zip(rows, values, strict=True)):
        end_s = round((row.time_ns - flagged_ns) / 1e9, 1)
        holder = next((name for begin, until, name in night["control"] if begin <= ends_s[end_s][0] < until), "series")
        axes = figure.add_axes((0.006 + place * 0.1105, 0.62, 0.104, 0.104 * WIDTH_PX / HEIGHT_PX))
        axes.imshow(picture, cmap=gold(), vmin=low, vmax=high, origin="lower")
        bad = ends_s[end_s][1]
        for side in axes.spines.values():
            side.set(color=PROBLEM if bad else COLOURS[holder], linewidth=3.0)
        axes.set(xticks=[], yticks=[])
        axes.set_title(
            "bad tip" if bad else holder.replace("tip_", ""), size=8.5, color=PROBLEM if bad else COLOURS[holder], pad=5
        )
        line = ConnectionPatch(
            xyA=(0.5, 0),
            coordsA=axes.transAxes,
            xyB=(end_s / 60, 2.55),
            coordsB=times.transData,
            color="#999999",
            lw=0.7,
        )
        figure.add_artist(line)
    figure.text(
        0.006, 0.945, "A night of afspm: the tip changes, and is repaired", size=10.5, weight="bold", va="center"
    )
    figure.text(0.994, 0.945, "SIMULATED", size=10.5, weight="bold", color=PROBLEM, ha="right", va="center")
    return figure


def _lanes(axes: Axes, night: dict[str, Any]) -> None:
    begin_s, end_s = night["span_s"]
    spans = [(0.0, night["cleared_s"], LANES[0]), *night["control"]]
    for begin, until, name in spans:
        axes.barh(LANES.index(name), (until - begin) / 60, left=begin / 60, height=0.66, color=COLOURS[name])
    marks = {"pulse": "v", "crash": "X"}
    for what, marker in marks.items():
        at = [time_s / 60 for time_s, action in night["actions"] if action == what]
        axes.plot(
            at,
            [1] * len(at),
            marker,
            color="white",
            markeredgecolor="black",
            markersize=7,
            label=what,
            linestyle="none",
        )
    axes.set_yticks(range(3), [f"flagged:\n{LANES[0]}", "control:\ntip corrector", "control:\nscan series"], size=8)
    axes.set(xlim=(begin_s / 60, end_s / 60), ylim=(-0.5, 2.5))
    axes.tick_params(axis="x", labelsize=8.5)
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel("minutes from the flag", size=8.5, labelpad=2)
    axes.legend(loc="lower left", fontsize=8, frameon=False, ncols=2, handletextpad=0.2, borderaxespad=0.1)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.set_facecolor("#f4f4f4")


if __name__ == "__main__":
    drawn = io.BytesIO()
    draw(Path(sys.argv[1])).savefig(drawn, dpi=DPI)
    Image.open(drawn).convert("RGB").quantize(128).save(PICTURE, optimize=True)
