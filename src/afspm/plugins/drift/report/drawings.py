"""Drawings of drift: each function returns one matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from afspm.basics import InvalidValue, typeset_length
from afspm.components import Array
from afspm.drawing import round_length_m
from afspm.plugins.drift.registration import DriftScan, Matches
from afspm.plugins.drift.report.style import (
    BLUE,
    GREEN,
    GREY,
    HOUR_S,
    MAGENTA,
    ORANGE,
    SIMULATED,
    TIME_COLOURS,
    WIDTH_IN,
    colour_bar,
    figure,
    letter,
    shared_span,
    show_scan,
    styled,
    three_digits,
    time_axis,
    unit_of,
)
from afspm.plugins.drift.track.record import DriftRecord


def draw_offsets(
    record: DriftRecord, *, truth_m: Array | None = None, switched_on_s: float | None = None, title: str = ""
) -> Figure:
    """Draw the displacement of the sample and its change over time, as in the paper's experiment.

    Args:
        record: drift record of the run.
        truth_m: (n, 2) true drift, from any origin; None if unknown.
        switched_on_s: time when drift correction was switched on.
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
        over_y.set_xlabel(f"time / h; bars: ± 2 sd, {_at_most(2 * sd, unit)}")
        made.colorbar(dots, ax=plane, label="time / h")
    return made


def _dots(ax: Axes, across: Array, up: Array, hours: Array) -> PathCollection:
    ax.plot(across, up, color=GREY, linewidth=0.5, zorder=1)
    return ax.scatter(across, up, c=hours, cmap=TIME_COLOURS, s=12, linewidths=0, zorder=3, label="estimated")


_PAIR_INCHES = 2.2


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two scans, and the displacement of features from the first to the second.

    Attributes:
        moved_m: (2,) in the frame of the image: position of a feature in the second scan, minus its position in the
            first.
        title: title of the pair, such as "correction off".
    """

    first: DriftScan
    second: DriftScan
    moved_m: Array
    title: str = ""


def draw_pairs(pairs: Sequence[ScanPair]) -> Figure:
    """Draw each pair as a row of two scans, with the displacement as an arrow in the second scan.

    Scans are shown in their own frames.
    """
    with styled():
        made = figure(2 * _PAIR_INCHES, 0.9 * _PAIR_INCHES * len(pairs))
        for row, pair in zip(made.subplots(len(pairs), 2, squeeze=False), pairs, strict=True):
            span = shared_span((pair.first, pair.second))
            row[0].set_ylabel("y / µm")
            for ax, scan in zip(row, (pair.first, pair.second), strict=True):
                image = show_scan(ax, scan, span)
                ax.set_xlabel("x / µm")
            colour_bar(row[1], image, pair.first.unit)
            hours = (pair.second.mid_s - pair.first.mid_s) / HOUR_S
            unit, factor = unit_of(pair.moved_m)
            row[0].set_title(pair.title, loc="left")
            row[1].set_title(f"{hours:.2f} h later: {np.hypot(*pair.moved_m) * factor:.1f} {unit}", loc="left")
            _arrow(row[1], pair)
    return made


def _arrow(ax: Axes, pair: ScanPair) -> None:
    # from the middle of the frame to the feature's place now, magnified if it were too short to see; the key arrow in
    # the lower right corner has the same magnification
    region, moved_m = pair.second.region, float(np.hypot(*pair.moved_m))
    start = 1e6 * np.asarray(region.center_m)
    ax.plot(*start, "o", color=ORANGE, markersize=3.5)
    if not moved_m > 0.0:
        return
    side_m = min(region.size_m)
    magnified = 1.0 if moved_m > 0.1 * side_m else max(1.0, round_length_m(0.3 * side_m / moved_m))
    how = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 1.8, "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", xy=tuple(start + 1e6 * magnified * pair.moved_m), xytext=tuple(start), arrowprops=how)
    key_m = round_length_m(0.3 * side_m / magnified)
    left, low = (1e6 * edge for edge in region.top_left_m)
    right, up = left + 0.95e6 * region.size_m[0], low + 0.06e6 * region.size_m[1]
    ax.annotate("", xy=(right, up), xytext=(right - 1e6 * key_m * magnified, up), arrowprops=how)
    often = "" if magnified == 1.0 else f", ×{magnified:.0f}"
    ax.text(right, up + 0.04e6 * region.size_m[1], f"{typeset_length(key_m)}{often}", size=6.5, color="white",
            ha="right", va="bottom", bbox={"facecolor": "black", "alpha": 0.5, "pad": 1.5, "linewidth": 0})  # fmt: skip


def draw_estimates(record: DriftRecord, *, title: str = "", truth_m: Array | None = None) -> Figure:
    """Draw the displacement of features since the first scan against time.

    Args:
        record: drift record of the pairs; `matched` marks accepted pairs.
        truth_m: (n, 2) true values, where known.
    """
    with styled():
        made = figure(WIDTH_IN, 2.6)
        ax = made.subplots()
        hours = (record.time_s - record.time_s[0]) / HOUR_S
        moved = record.misplacement_m
        unit, factor = unit_of(moved[record.matched])
        for axis, (name, colour, marker) in enumerate((("x", BLUE, "o"), ("y", ORANGE, "s"))):
            _estimates(
                ax, record, hours, moved[:, axis] * factor, record.sd_m[:, axis] * factor, (name, colour, marker), unit
            )
            if truth_m is not None:
                ax.plot(hours, truth_m[:, axis] * factor, color=colour, linewidth=0.8, label=f"{name}, true")
        _refused(ax, hours[~record.matched])
        ax.axhline(0.0, color="black", linewidth=0.4)
        ax.set(ylabel=f"displacement / {unit}", title=title)
        ax.legend(ncols=5, loc="best")
        time_axis(ax)
    return made


def _at_most(bars: Array, unit: str) -> str:
    # bars smaller than the markers can't be seen
    return f"at most {three_digits(float(np.max(bars, initial=0.0, where=np.isfinite(bars))))} {unit}"


def _estimates(
    ax: Axes, record: DriftRecord, hours: Array, at: Array, sd: Array, how: tuple[str, str, str], unit: str
) -> None:
    (name, colour, marker), good = how, record.matched
    ax.errorbar(
        hours[good],
        at[good],
        2 * sd[good],
        fmt=marker,
        color=colour,
        markersize=3,
        elinewidth=0.6,
        label=f"{name} ± 2 sd, {_at_most(2 * sd[good], unit)}",
    )


def _refused(ax: Axes, hours: Array) -> None:
    if hours.size:
        height = np.full(hours.shape, 0.02)
        ax.plot(hours, height, "x", color=GREY, markersize=4, transform=ax.get_xaxis_transform(), label="refused")


_MOST_BINS = 100
_LEAST_BINNED = 12
"""Fewer values are drawn one by one: bins of three would show a shape that is not there."""


def draw_histogram(record: DriftRecord, *, title: str = "") -> Figure:
    """Draw histograms of the displacement (x, y and distance) in the accepted pairs; the first scan is left out."""
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
            _histogram(ax, values * factor, colour, unit)
            counted_scans = "scans" if len(values) >= _LEAST_BINNED else "scans up to this value"
            ax.set(xlabel=f"{name} / {unit}", ylabel=counted_scans if name == "x" else "")
        made.suptitle(title, size=7)
    return made


def freedman_diaconis(values: Array) -> Array:
    """Return the edges of equal histogram bins, of width 2 IQR n^(-1/3) or slightly less.

    There are at most 100 bins, and one bin if the interquartile range (IQR) is zero.

    This width makes the histogram close to the density in the mean square (D. Freedman, P. Diaconis, Z.
    Wahrscheinlichkeitstheorie verw. Gebiete 57, 453, 1981).
    """
    low, high = float(values.min()), float(values.max())
    quarter, three_quarters = np.percentile(values, (25, 75))
    width = 2.0 * (three_quarters - quarter) / len(values) ** (1 / 3)
    count = int(np.ceil((high - low) / width)) if width > 0.0 else 1
    if high == low:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, min(max(count, 1), _MOST_BINS) + 1)


def round_bins(values: Array) -> Array:
    """Return the edges of at least √n bins of round width, no wider than the bins of `freedman_diaconis`."""
    edges = freedman_diaconis(values)
    span = float(edges[-1] - edges[0])
    width = round_length_m(min(float(edges[1] - edges[0]), span / np.sqrt(len(values))))
    first, last = np.floor(edges[0] / width + 1e-9), np.ceil(edges[-1] / width - 1e-9)
    return np.asarray(width * np.arange(first, last + 1.0))


def _histogram(ax: Axes, values: Array, colour: str, unit: str) -> None:
    if values.size == 0:
        ax.text(0.5, 0.5, "no pair was accepted", ha="center", transform=ax.transAxes)
        return
    if len(values) < _LEAST_BINNED:
        ax.plot(np.sort(values), np.arange(1, len(values) + 1), "o", color=colour, markersize=3)
        ax.set_ylim(0.0, len(values) + 1.0)
    else:
        ax.hist(values, round_bins(values).tolist(), color=colour, edgecolor="white", linewidth=0.5)
    ax.axvline(float(np.median(values)), color="black", linewidth=0.8)
    ax.yaxis.set_major_locator(MaxNLocator(integer=True))
    median, rms = (three_digits(float(value)) for value in (np.median(values), np.sqrt(np.mean(values**2))))
    ax.set_title(f"median {median} {unit}, rms {rms} {unit}, n = {len(values)}", size=6.5)


_MOST_LINES = 60
_INCHES = 2.6


def draw_features(reference: DriftScan, scan: DriftScan, matches: Matches | None) -> Figure:
    """Draw both scans twice: (a) with the matched keypoints; (b) with lines between matches, dotted for outliers.

    Raises:
        InvalidValue: the estimator matches no features.
    """
    if matches is None:
        raise InvalidValue("this estimator uses no features", hint='e.g. estimator "brief"')
    with styled():
        made = figure(2 * _INCHES, 2 * _INCHES + 0.3)
        rows, span = made.subplots(2, 2), shared_span((reference, scan))
        for row in rows:
            for ax, one in zip(row, (reference, scan), strict=True):
                show_scan(ax, one, span)
                ax.set_xlabel("x / µm")
            row[0].set_ylabel("y / µm")
            row[1].set_yticklabels([])  # the lines between the scans cross them
        points = [_in_frame(one, at) for one, at in ((reference, matches.reference_m), (scan, matches.scan_m))]
        for ax, at in zip(rows[0], points, strict=True):
            ax.plot(at[:, 0], at[:, 1], "o", markersize=4, markerfacecolor="none", markeredgecolor=ORANGE)
        letter(rows[0, 0], "a")
        letter(rows[1, 0], "b")
        inliers = matches.inlier
        rows[1, 1].set_title(f"{np.count_nonzero(inliers)} inliers of {len(inliers)} pairs", loc="right")
        _join(made, rows[1], points, ~inliers, None)
        _join(made, rows[1], points, inliers, "viridis")
    return made


def _in_frame(scan: DriftScan, xy_m: Array) -> Array:
    # positions in the frame before rotation, µm
    angle = scan.region.angle_rad
    cos, sin = np.cos(angle), np.sin(angle)
    center = np.asarray(scan.region.center_m)
    turned_back: Array = ((xy_m - center) @ np.array([[cos, -sin], [sin, cos]]) + center) * 1e6
    return turned_back


def _join(made: Figure, axes: Array, points: list[Array], which: NDArray[np.bool_], colours: str | None) -> None:
    # an even selection of lines: too many would hide the scans
    from matplotlib import colormaps

    chosen = np.flatnonzero(which)
    if len(chosen) > _MOST_LINES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, _MOST_LINES).round().astype(int)]
    for rank, index in enumerate(chosen):
        colour = MAGENTA if colours is None else colormaps[colours](rank / max(len(chosen) - 1, 1))
        line = ConnectionPatch(
            points[0][index], points[1][index], "data", "data", axesA=axes[0], axesB=axes[1], color=colour,
            linewidth=0.6, linestyle=":" if colours is None else "-",
        )  # fmt: skip
        made.add_artist(line)
        for ax, at in zip(axes, points, strict=True):
            ax.plot(*at[index], "x" if colours is None else "o", color=colour, markersize=3)


def draw_errors(record: DriftRecord, truth_m: Array, *, switched_on_s: float | None = None) -> Figure:
    """Draw two errors against time: (a) the misplacement of each scan; (b) the estimated minus the true drift.

    The misplacement is the distance on the sample from the place of the first scan.

    Args:
        record: drift record of the run.
        truth_m: (n, 2) true displacement at the middle of each scan, from any origin.
        switched_on_s: time when drift correction was switched on.
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
        above.set_title(SIMULATED, loc="right")  # the truth of another night is not known
        letter(above, "a")
        letter(below, "b")
        time_axis(below)
    return made


def _misplaced(ax: Axes, off_m: Array, hours: Array) -> None:
    distance_m = np.hypot(*off_m.T)
    distance_m[distance_m == 0.0] = np.nan  # a logarithmic axis has no place for the first scan's zero
    ax.semilogy(hours, distance_m * 1e9, "o-", color="black", markersize=2.5, linewidth=0.6)
    ax.set_ylabel("position error of the scan / nm")


def _known(ax: Axes, record: DriftRecord, truth_m: Array, hours: Array) -> None:
    error_m = record.drift_m - record.drift_m[:1] - truth_m
    unit, factor = unit_of(error_m, 2 * record.sd_m)
    for axis, (name, colour, style) in enumerate((("x", BLUE, ":"), ("y", ORANGE, "--"))):
        ax.plot(hours, error_m[:, axis] * factor, color=colour, linewidth=0.9, label=f"{name}, estimated − true")
        sd = record.sd_m[1:, axis] * factor  # displacements are counted from the first scan
        # lines: two bands of nearly the same width would lie on each other as grey
        for side, label in ((-2, ""), (2, f"± 2 sd, {name}")):
            ax.plot(hours[1:], side * sd, color=colour, linewidth=0.7, linestyle=style, label=label or None)
    ax.axhline(0.0, color=GREY, linewidth=0.4)
    ax.set_ylabel(f"error of the estimate / {unit}")
    if len(error_m) > 1:
        mean, rms = error_m[1:].mean(axis=0) * factor, np.sqrt((error_m[1:] ** 2).mean(axis=0)) * factor
        both = (f"{name} ({', '.join(map(three_digits, xy))}) {unit}" for name, xy in (("bias", mean), ("rms", rms)))
        ax.set_title(", ".join(both), loc="right")
    ax.legend(ncols=2, loc="best")
