"""The offset of a whole run in three graphs: y against x, and x and y against time, coloured by time."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from afspm.drift.figures.style import (
    BLUE,
    GREY,
    HOUR_S,
    TIME_COLOURS,
    Array,
    figure,
    styled,
    time_axis,
    unit_of,
)  # fmt: skip
from afspm.drift.record import DriftRecord


def draw(
    record: DriftRecord, *, truth_m: Array | None = None, switched_on_s: float | None = None, title: str = ""
) -> Figure:
    """As in the paper's experiment: how far the sample has come, and how its velocity changes.

    Args:
        record: of the run.
        truth_m: (n, 2) what the drift really was, from any zero on, where somebody knows.
        switched_on_s: when drift correction was switched on.
    """
    with styled():
        made = figure(3.6, 6.2)
        plane, over_x, over_y = made.subplots(3, 1, gridspec_kw={"height_ratios": (2.2, 1, 1)})
        hours = (record.time_s - record.time_s[0]) / HOUR_S
        unit, factor = unit_of(record.drift_m)
        drift, sd = record.drift_m * factor, record.sd_m * factor
        dots = _dots(plane, drift[:, 0], drift[:, 1], hours)
        plane.set(xlabel=f"x / {unit}", ylabel=f"y / {unit}", aspect="equal", title=title)
        plane.set_adjustable("datalim")
        for axis, (ax, name) in enumerate(((over_x, "x"), (over_y, "y"))):
            ax.errorbar(hours, drift[:, axis], 2 * sd[:, axis], fmt="none", ecolor=GREY, elinewidth=0.6)
            _dots(ax, hours, drift[:, axis], hours)
            ax.set_ylabel(f"{name} / {unit}")
            if switched_on_s is not None:
                ax.axvline((switched_on_s - record.time_s[0]) / HOUR_S, color=BLUE, linestyle="--", linewidth=0.8)
        if truth_m is not None:
            truth_m = truth_m - truth_m[:1] + record.drift_m[:1]
            for ax, across, up in ((plane, truth_m[:, 0] * factor, 1), (over_x, hours, 0), (over_y, hours, 1)):
                ax.plot(across, truth_m[:, up] * factor, color="black", linewidth=0.6, zorder=1, label="true")
            plane.legend(loc="best")
        if switched_on_s is not None:
            over_x.set_title("correction: off ¦ on", loc="center", color=BLUE)
        time_axis(over_x, label=False)
        time_axis(over_y)
        made.colorbar(dots, ax=plane, label="time / h")
    return made


def _dots(ax: Axes, across: Array, up: Array, hours: Array) -> PathCollection:
    ax.plot(across, up, color=GREY, linewidth=0.5, zorder=1)
    return ax.scatter(across, up, c=hours, cmap=TIME_COLOURS, s=12, linewidths=0, zorder=3)
