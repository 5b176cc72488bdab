"""Off-line estimates, each of one pair by itself: the first scan against every later one."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from afspm.drift.figures.style import BLUE, GREY, HOUR_S, ORANGE, WIDTH_IN, Array, figure, styled, time_axis, unit_of
from afspm.drift.record import DriftRecord


def draw(record: DriftRecord, *, title: str = "", truth_m: Array | None = None) -> Figure:
    """How far the features lie from where they were in the first scan, against time.

    Args:
        record: of the pairs; `matched` says which were accepted.
        truth_m: (n, 2) what it really was, where somebody knows.
    """
    with styled():
        made = figure(WIDTH_IN, 2.6)
        ax = made.subplots()
        hours = (record.time_s - record.time_s[0]) / HOUR_S
        moved = record.misplacement_m
        unit, factor = unit_of(moved[record.matched])
        for axis, (name, colour, marker) in enumerate((("x", BLUE, "o"), ("y", ORANGE, "s"))):
            _estimates(
                ax, record, hours, moved[:, axis] * factor, record.sd_m[:, axis] * factor, (name, colour, marker)
            )
            if truth_m is not None:
                ax.plot(hours, truth_m[:, axis] * factor, color=colour, linewidth=0.8, label=f"{name}, true")
        _refused(ax, hours[~record.matched])
        ax.axhline(0.0, color="black", linewidth=0.4)
        ax.set(ylabel=f"displacement / {unit}", title=title)
        ax.legend(ncols=5, loc="best")
        time_axis(ax)
    return made


def _estimates(ax: Axes, record: DriftRecord, hours: Array, at: Array, sd: Array, how: tuple[str, str, str]) -> None:
    (name, colour, marker), good = how, record.matched
    ax.errorbar(
        hours[good],
        at[good],
        2 * sd[good],
        fmt=marker,
        color=colour,
        markersize=3,
        elinewidth=0.6,
        label=f"{name} ± 2 sd",
    )


def _refused(ax: Axes, hours: Array) -> None:
    if hours.size:
        height = np.full(hours.shape, 0.02)
        ax.plot(hours, height, "x", color=GREY, markersize=4, transform=ax.get_xaxis_transform(), label="refused")
