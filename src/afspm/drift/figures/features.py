"""What a feature method rests on: keypoints, and the pairs that it matched, inliers and outliers apart."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from numpy.typing import NDArray

from afspm.drift.figures.style import MAGENTA, ORANGE, Array, figure, letter, show_scan, styled
from afspm.drift.registration import DriftScan, Matches
from afspm.errors import InvalidValue

_MOST_LINES = 60
_INCHES = 2.6


def draw(reference: DriftScan, scan: DriftScan, matches: Matches | None) -> Figure:
    """a: both scans with the matched keypoints in orange; b: the pairs joined, inliers in colour, outliers dotted.

    Raises:
        InvalidValue: an estimator that matches no features.
    """
    if matches is None:
        raise InvalidValue("this estimate does not rest on features", hint='e.g. estimator "brief"')
    with styled():
        made = figure(2 * _INCHES, 2 * _INCHES + 0.3)
        rows = made.subplots(2, 2)
        for row in rows:
            for ax, one in zip(row, (reference, scan), strict=True):
                show_scan(ax, one)
                ax.set_xlabel("x / µm")
            row[0].set_ylabel("y / µm")
            row[1].set_yticklabels([])  # the lines come across
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
    """Positions in the frame before it is turned, in which scans are drawn, in µm."""
    angle = scan.region.angle_rad
    cos, sin = np.cos(angle), np.sin(angle)
    center = np.asarray(scan.region.center_m)
    turned_back: Array = ((xy_m - center) @ np.array([[cos, -sin], [sin, cos]]) + center) * 1e6
    return turned_back


def _join(made: Figure, axes: Array, points: list[Array], which: NDArray[np.bool_], colours: str | None) -> None:
    """Lines between the two scans; of many, some evenly chosen: all would hide the scans."""
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
