"""Figure of docs/how-to/map-adaptively.md: one spotty map, measured by a nested grid and adaptively.

`python -m benchmarks.adaptive --seed 20 --figure docs/pictures/adaptive-map.png`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from afspm.drawing.palette import CATEGORICAL, PROBLEM
from afspm.drawing.plotting import draw_scale_bar, gold
from afspm.plugins.adaptive.refinement import AdaptiveMap, NestedGrid
from afspm.simulation.property_map import PropertyMap
from benchmarks.adaptive import GOAL, KINDS, REGION, Case, Course, course

_TEXT = 9.0


def draw(path: Path, seed: int) -> None:
    """Draw the measured positions over the true map at the goal, and the error over the seconds."""
    case = Case("spotty", "slow", "off", seed)
    courses = {"nested grid": course(NestedGrid, case), "adaptive": course(AdaptiveMap, case)}
    axis_m = np.linspace(-0.5e-6, 0.5e-6, 200)
    truth = PropertyMap(KINDS["spotty"], seed).at(axis_m[None, :], axis_m[:, None])
    figure = Figure(figsize=(9.6, 3.5), facecolor="white")
    FigureCanvasAgg(figure)
    for place, (name, one) in enumerate(courses.items()):
        axes = figure.add_axes((0.01 + 0.285 * place, 0.03, 0.27, 0.82))
        drawn = axes.imshow(truth, origin="lower", extent=(-0.5, 0.5, -0.5, 0.5), cmap=gold())
        x, y = one.measurements[:, :2].T * 1e6
        axes.plot(x, y, ".", color=CATEGORICAL[0], markersize=4.0, markeredgewidth=0.0)
        axes.set_xlim(-0.52, 0.52)
        axes.set_ylim(-0.52, 0.52)
        axes.set_axis_off()
        axes.set_title(f"{name}: {len(x)} spectra, {one.until(GOAL) / 3600:.1f} h", size=_TEXT)
        draw_scale_bar(axes, REGION.size_m, (-0.5, -0.5), 1e6, font=_TEXT)
    bar_axes = figure.add_axes((0.588, 0.03, 0.012, 0.82))
    figure.colorbar(drawn, cax=bar_axes).set_label("gap (eV)", size=_TEXT)
    bar_axes.tick_params(labelsize=_TEXT)
    axes = figure.add_axes((0.72, 0.16, 0.26, 0.69))
    for colour, (name, one) in zip((CATEGORICAL[3], CATEGORICAL[0]), courses.items(), strict=True):
        _curve(axes, one, colour, name)
    axes.axhline(GOAL, color="grey", linewidth=0.8, linestyle="--")
    axes.set_yscale("log")
    axes.set_yticks([0.1, 0.2, 0.5, 1.0], ["0.1", "0.2", "0.5", "1"])
    axes.minorticks_off()
    axes.set_xlabel("time (h)", size=_TEXT)
    axes.set_title("rms error / spread of the map", size=_TEXT)
    axes.tick_params(labelsize=_TEXT)
    axes.legend(fontsize=_TEXT, frameon=False)
    figure.text(0.985, 0.95, "SIMULATED", size=10, weight="bold", color=PROBLEM, ha="right", va="center")
    figure.savefig(path, dpi=160)


def _curve(axes: object, one: Course, colour: str, name: str) -> None:
    axes.plot(np.array(one.seconds) / 3600, one.errors, color=colour, label=name)  # type: ignore[attr-defined]
