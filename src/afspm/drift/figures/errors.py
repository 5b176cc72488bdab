"""What only a simulation can draw: the true errors against time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

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
    """a: how far off the scans were taken; b: what was known after each scan, minus the truth, within its own error.

    Args:
        record: of the run.
        truth_m: (n, 2) the true displacement at the middle of each scan.
        switched_on_s: when drift correction was switched on; misplacement is counted from the first scan after it.
    """
    with styled():
        made = figure(WIDTH_IN, 4.2)
        above, below = made.subplots(2, 1, sharex=True)
        hours = (record.time_s - record.time_s[0]) / HOUR_S
        on = np.ones(len(record), bool) if switched_on_s is None else record.time_s >= switched_on_s
        came_m = truth_m - truth_m[:1]
        _misplaced(above, record, came_m, hours, on)
        _known(below, record, came_m, hours)
        if switched_on_s is not None:
            for ax in (above, below):
                ax.axvline((switched_on_s - record.time_s[0]) / HOUR_S, color=BLUE, linestyle="--", linewidth=0.8)
            above.set_title("correction: off ¦ on", color=BLUE)
        letter(above, "a")
        letter(below, "b")
        time_axis(below)
    return made


def _misplaced(ax: Axes, record: DriftRecord, truth_m: Array, hours: Array, on: NDArray[np.bool_]) -> None:
    off_m = np.hypot(*(truth_m - (record.center_m - record.center_m[:1])).T)
    if on.any():  # in the hours without correction only the sample moves; what follows is held where it was then
        first = int(np.argmax(on))
        held = (truth_m - truth_m[first]) - (record.center_m - record.center_m[first])
        off_m = np.where(on, np.hypot(*held.T), off_m)
    unit, factor = unit_of(np.median(off_m[on]) * 10 if on.any() else off_m)
    ax.semilogy(
        hours, np.where(off_m > 0.0, off_m * factor, np.nan), "o-", color="black", markersize=2.5, linewidth=0.6
    )
    ax.set_ylabel(f"scan taken off its place / {unit}")


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
