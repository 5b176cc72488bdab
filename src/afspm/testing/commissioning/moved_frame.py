"""The frame, tried: how far and where to the picture moves if the frame is moved by a known offset.

Four scans show the two axes: one, one moved along x, one moved along y, and the first again for the drift between them.
Two scans of a turned frame, moved along its own x, show the angle. Positions are in pixels or in the frame's own axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.signal import correlate

from afspm.model import Scan
from afspm.model.arrays import Array
from afspm.model.line_levelling import Levelling, levelled
from afspm.testing.conformance import Skipped, expect
from afspm.testing.translators.measuring import TURN_RAD

LIKE: Final = 0.6
"""Least correlation of two pictures that show the same structure."""
OFFSETS: Final = ((-0.1, -0.1), (0.1, -0.1), (-0.1, 0.1))
"""Centres of the frames that are compared, as fractions of the whole frame: one, moved along x, moved along y."""
PART: Final = (0.5, 0.5)
PIXELS: Final = (64, 64)
_OVERLAP: Final = 0.45
"""Least overlap of two pictures: a move of .4 along any direction leaves half of one."""
_RIVAL: Final = 0.05
"""Least distance in correlation of the best displacement from another one, which a lattice would have."""
_LENGTH: Final = 0.05
"""Tolerance of lengths: half a pixel of twenty, and creep."""
_ANGLE_DEG: Final = 2.5


@dataclass(frozen=True)
class Displacement:
    """The move (x, y) of a frame, in pixels, as two pictures show it.

    Attributes:
        likeness: correlation of the overlap.
        is_ambiguous: True if another move fits almost as well, as on a lattice.
    """

    move: Array
    likeness: float
    is_ambiguous: bool


def displacement(before: Array, after: Array) -> Displacement:
    """Return the move of the frame between two pictures of the same shape, [y, x] with y upwards."""
    a, b = (levelled(one, Levelling.PLANE) for one in (before, after))
    one = np.ones_like(a)
    count = np.maximum(correlate(one, one, method="fft"), 1.0)
    sum_a, sum_b = correlate(a, one, method="fft"), correlate(one, b, method="fft")
    covariance = correlate(a, b, method="fft") - sum_a * sum_b / count
    spread_a = correlate(a**2, one, method="fft") - sum_a**2 / count
    spread_b = correlate(one, b**2, method="fft") - sum_b**2 / count
    likeness = covariance / np.sqrt(np.maximum(spread_a * spread_b, 1e-12 * (a**2).sum() * (b**2).sum() + 1e-300))
    likeness[count < _OVERLAP * a.size] = -1.0
    row, column = np.unravel_index(np.argmax(likeness), likeness.shape)
    best = float(likeness[row, column])
    rows, columns = np.indices(likeness.shape)
    far = np.hypot(rows - row, columns - column) > 0.15 * min(a.shape)
    middle = np.array(a.shape[::-1]) - 1.0
    at = np.array([_peak(likeness[row, :], int(column)), _peak(likeness[:, column], int(row))])
    return Displacement(at - middle, best, bool(likeness[far].max() > best - _RIVAL))


def _peak(values: Array, at: int) -> float:
    # the vertex of the parabola through the largest value and its neighbours
    if not 0 < at < len(values) - 1:
        return float(at)
    low, top, high = values[at - 1 : at + 2]
    curve = low - 2.0 * top + high
    return at + float(0.5 * (low - high) / curve) if curve < 0.0 else float(at)


def moves(taken: list[list[Scan]]) -> list[list[Array]]:
    """Return the moves of the upright pictures and of the turned ones, in units of the frame's, by the best channel.

    Args:
        taken: all channels of each scan: of `OFFSETS`, of the first one again, and of two turned frames, if tried.

    Raises:
        Skipped: no channel shows the moves.
        Failed: the scans have no channel in common.
    """
    groups = [taken[:4], taken[4:]] if taken[4:] else [taken]
    seen = [
        [[displacement(group[0][i].values, one[i].values) for one in group[1:]] for group in groups]
        for i in range(min(map(len, taken)))
        if len({one[i].channel for one in taken}) == 1 and all(one[i].shape == PIXELS for one in taken)
    ]
    expect(seen, "the same channels in all scans", "no channel that all have")
    best = max(seen, key=lambda channel: min(one.likeness for group in channel for one in group))
    for one in (one for group in best for one in group):
        if one.likeness < LIKE:
            raise Skipped(f"no structure is seen in all scans (correlation {one.likeness:.2f}): noise shows no move")
        if one.is_ambiguous:
            raise Skipped("the structure repeats, so that several moves fit: choose a place without a lattice")
    unit_px = 0.2 / 0.5 * (np.array(PIXELS[::-1]) - 1.0)
    drift = best[0][2].move / unit_px
    upright = [one.move / unit_px - drift * part for one, part in zip(best[0], (1 / 3, 2 / 3, 0), strict=True)]
    cos, sin = math.cos(TURN_RAD), math.sin(TURN_RAD)
    turned = [
        [one.move / unit_px - np.array([[cos, sin], [-sin, cos]]) @ drift / 3 for one in group] for group in best[1:]
    ]
    return [upright, *turned]


def faults(along_x: Array, along_y: Array, turned: Array | None, turned_deg: float = 0.0) -> list[str]:
    """Return the faults of a frame, in words; empty: none.

    Args:
        along_x, along_y: the picture's move in units of the frame's, for a frame that is moved along x, and along y.
        turned: the same for a frame turned by `turned_deg`, in its own axes, moved along its own x; None: not tried.
    """
    found = []
    moves = np.stack([along_x, along_y], axis=1)
    if abs(moves[0, 1] * moves[1, 0]) > abs(moves[0, 0] * moves[1, 1]):
        found.append("x and y are swapped")
        moves = moves[::-1]
    for axis, name in enumerate("xy"):
        if moves[axis, axis] < 0.0:
            found.append(f"{name} is mirrored")
            moves = moves * np.where(np.arange(2) == axis, -1.0, 1.0)[:, None]
    for axis, name in enumerate("xy"):
        length = float(np.hypot(*moves[:, axis]))
        if abs(length - 1.0) > _LENGTH:
            found.append(f"the scale is wrong along {name}: a move of 1 shows as {length:.2f}")
    angles_deg = [math.degrees(math.atan2(*one)) for one in ((-moves[1, 0], moves[0, 0]), (moves[0, 1], moves[1, 1]))]
    if max(map(abs, angles_deg)) > _ANGLE_DEG:
        at = ", ".join(f"{angle:+.1f} deg from {name}" for angle, name in zip(angles_deg, "xy", strict=True))
        found.append(f"the angle is wrong: the picture is turned by {at}, counter-clockwise")
    if turned is not None and not found:
        came_deg = turned_deg - math.degrees(math.atan2(turned[1], turned[0]))
        if abs(came_deg - turned_deg) > _ANGLE_DEG:
            found.append(f"the angle is wrong: a frame turned by {turned_deg:.3g} deg is turned by {came_deg:.1f} deg")
    return found
