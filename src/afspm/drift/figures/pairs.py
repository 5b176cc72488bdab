"""Pairs of scans with the way that the sample went between them as an orange arrow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afspm.drift.figures.style import HOUR_S, ORANGE, Array, figure, show_scan, styled, unit_of
from afspm.drift.registration import DriftScan

_INCHES = 2.2


@dataclass(frozen=True, eq=False)
class Pair:
    """Two scans, and by how much the features lie elsewhere within the second.

    Attributes:
        moved_m: (2,) in the frame of the image: where a feature of the first is in the second, minus where it was.
        title: e.g. "correction off".
    """

    first: DriftScan
    second: DriftScan
    moved_m: Array
    title: str = ""


def draw(pairs: Sequence[Pair]) -> Figure:
    """A row of two scans for each pair, in their own frames, with the arrow in the second."""
    with styled():
        made = figure(2 * _INCHES, (_INCHES + 0.15) * len(pairs))
        for row, pair in zip(made.subplots(len(pairs), 2, squeeze=False), pairs, strict=True):
            for ax, scan in zip(row, (pair.first, pair.second), strict=True):
                show_scan(ax, scan)
                ax.set(xlabel="x / µm", ylabel="y / µm")
            hours = (pair.second.mid_s - pair.first.mid_s) / HOUR_S
            unit, factor = unit_of(pair.moved_m)
            row[0].set_title(pair.title, loc="left")
            row[1].set_title(f"{hours:.2f} h later: {np.hypot(*pair.moved_m) * factor:.1f} {unit}", loc="left")
            _arrow(row[1], pair)
    return made


def _arrow(ax: Axes, pair: Pair) -> None:
    """From the middle of the frame to where that feature is now; a dot, where that is less than a pixel away."""
    start = 1e6 * np.asarray(pair.second.region.center_m)
    end = start + 1e6 * pair.moved_m
    if np.hypot(*pair.moved_m) > max(pair.second.pixel_m):
        how = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.8, "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", xy=tuple(end), xytext=tuple(start), arrowprops=how)
    ax.plot(*start, "o", color=ORANGE, markersize=3.5)
