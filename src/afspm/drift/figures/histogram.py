"""The distribution of displacements, with bins after Freedman and Diaconis."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afspm.drift.figures.style import BLUE, GREEN, ORANGE, WIDTH_IN, Array, figure, styled, unit_of
from afspm.drift.record import DriftRecord

_MOST_BINS = 100


def draw(record: DriftRecord, *, title: str = "") -> Figure:
    """Of x, of y and of the distance, for the pairs that were accepted (the first scan itself left out)."""
    moved = record.misplacement_m[1:][record.matched[1:]]
    with styled():
        made = figure(WIDTH_IN, 2.2)
        unit, factor = unit_of(moved)
        distance = np.hypot(*moved.T)
        columns = zip(
            made.subplots(1, 3), (moved[:, 0], moved[:, 1], distance), ("x", "y", "distance"), (BLUE, ORANGE, GREEN),
            strict=True,
        )  # fmt: skip
        for ax, values, name, colour in columns:
            _histogram(ax, values * factor, colour)
            ax.set(xlabel=f"{name} / {unit}", ylabel="scans" if name == "x" else "")
        made.suptitle(title, size=7)
    return made


def freedman_diaconis(values: Array) -> Array:
    """Edges of bins as wide as 2 IQR n^(-1/3), which makes the histogram close to the density in the mean square (D.
    Freedman, P. Diaconis, Z. Wahrscheinlichkeitstheorie verw. Gebiete 57, 453, 1981). One bin where all are alike."""
    low, high = float(values.min()), float(values.max())
    quarter, three_quarters = np.percentile(values, (25, 75))
    width = 2.0 * (three_quarters - quarter) / len(values) ** (1 / 3)
    count = int(np.ceil((high - low) / width)) if width > 0.0 else 1
    if high == low:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, min(max(count, 1), _MOST_BINS) + 1)


def _histogram(ax: Axes, values: Array, colour: str) -> None:
    if values.size == 0:
        ax.text(0.5, 0.5, "no pair was accepted", ha="center", transform=ax.transAxes)
        return
    ax.hist(values, freedman_diaconis(values).tolist(), color=colour, edgecolor="white", linewidth=0.5)
    ax.axvline(float(np.median(values)), color="black", linewidth=0.8)
    ax.set_title(f"median {np.median(values):.2f}, rms {np.sqrt(np.mean(values**2)):.2f}, n = {len(values)}", size=6.5)
