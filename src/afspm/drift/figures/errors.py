"""What only a simulation can draw: the true errors against time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afspm.drift.figures.style import (
    BLUE,
    GREY,
    HOUR_S,
    ORANGE,
    WIDTH_IN,
    Array,
    figure,
    letter,
    styled,
    time_axis,
    unit_of,
)
from afspm.drift.record import DriftRecord


def draw(record: DriftRecord, truth_m: Array, *, switched_on_s: float | None = None) -> Figure:
    """a: how far off the place of the first scan each was taken; b: what was known after it, minus the truth.

    Args:
        record: of the run.
        truth_m: (n, 2) the true displacement at the middle of each scan, from any zero on.
        switched_on_s: when drift correction was switched on.
    """
    with styled():
        made = figure(WIDTH_IN, 4.2)
        above, below = made.subplots(2, 1, sharex=True)
        hours = (record.time_s - record.time_s[0]) / HOUR_S
        came_m = truth_m - truth_m[:1]
        _misplaced(above, came_m - (record.center_m - record.center_m[:1]), hours)
        _known(below, record, came_m, hours)
        if switched_on_s is not None:
            for ax in (above, below):
                ax.axvline((switched_on_s - record.time_s[0]) / HOUR_S, color=BLUE, linestyle="--", linewidth=0.8)
            above.set_title("correction: off ¦ on", color=BLUE)
        letter(above, "a")
        letter(below, "b")
        time_axis(below)
    return made


def _misplaced(ax: Axes, off_m: Array, hours: Array) -> None:
    distance_m = np.hypot(*off_m.T)
    distance_m[distance_m == 0.0] = np.nan  # that of the first scan has no place on a logarithmic axis
    ax.semilogy(hours, distance_m * 1e9, "o-", color="black", markersize=2.5, linewidth=0.6)
    ax.set_ylabel("scan off its place / nm")


def _known(ax: Axes, record: DriftRecord, truth_m: Array, hours: Array) -> None:
    error_m = record.drift_m - record.drift_m[:1] - truth_m
    unit, factor = unit_of(error_m)
    for axis, (name, colour) in enumerate((("x", BLUE), ("y", ORANGE))):
        sd = record.sd_m[:, axis] * factor
        ax.fill_between(hours, -2 * sd, 2 * sd, color=colour, alpha=0.15, linewidth=0, label=f"± 2 sd, {name}")
        ax.plot(hours, error_m[:, axis] * factor, color=colour, linewidth=0.9, label=f"{name}, believed - true")
    ax.axhline(0.0, color=GREY, linewidth=0.4)
    ax.set_ylabel(f"error of what is known / {unit}")
    ax.legend(ncols=2, loc="best")
