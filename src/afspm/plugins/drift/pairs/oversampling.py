"""Scenes with smaller pixels than their features need, which are fitted with pixels twice as large.

The time of a fit grows with the number of pixels, and in most large scans tip and feedback blur features over several.
"""

from __future__ import annotations

import numpy as np

from afspm.components import Array
from afspm.plugins.drift.pairs.images import CommonGrid, Image
from afspm.plugins.drift.pairs.noise import without_lines
from afspm.plugins.drift.pairs.warp import OverlapBox, Scene, WarpedPair, in_whole_blocks

LEAST_HALVED_PX = 128  # least side of a halved image: less may be too little to prove a match
MOST_LOST = 0.01  # share of the information about the shift
KEPT = 3 / 8
"""Frequencies that count as kept, over the highest one. Filters and splines lose some below half of it: with half, the
errors on lattices grew by a third, and on rough surfaces by a tenth."""
SEEN_PX = 256  # largest side of the part that is looked at
BANDS = 16  # in each direction, over which powers are averaged
CERTAIN = 5.0  # standard deviations of an average from which it counts


def with_larger_pixels(scene: Scene, grid: CommonGrid, theta: Array) -> tuple[Scene, CommonGrid, Array]:
    """Return a scene with pixels twice as large, as often as this loses nothing, with its grid and theta.

    Args:
        theta: displacement, known to a fraction of a pixel; see `warp.WarpedPair`.
    """
    while lost_by_halving(scene, theta) <= MOST_LOST:
        (first, cut1), (second, cut2) = (_halved(image) for image in (scene.first, scene.second))
        scene, grid, theta = Scene(first, second), grid.halved(cut1, cut2), theta.copy()
        theta[:2] = (theta[:2] - cut1 + cut2) / 2
    return scene, grid, theta


def lost_by_halving(scene: Scene, theta: Array) -> float:
    """Return the share of the information about the shift above the frequencies that are kept; 1 for small images.

    A frequency f with signal S and noise N holds f² S² / (N (N + 2 S)). Both are known from the two aligned images: S
    from their product, N from their difference. So no spectrum of the noise is assumed. The middle of the overlap
    suffices, since tip and feedback blur all places alike.
    """
    from scipy.fft import dctn

    if min(*scene.first.values.shape, *scene.second.values.shape) < 2 * LEAST_HALVED_PX:
        return 1.0
    box = scene.box(theta[:2])
    if box is None:
        return 1.0
    inner = OverlapBox(*(axis[max(1, (axis.size - SEEN_PX) // 2) :][:SEEN_PX] for axis in (box.x[:-1], box.y[:-1])))
    pair = WarpedPair(*scene.splines((scene.first.values, scene.second.values)), inner, theta[:2])
    one, two, known = pair.warped(theta)
    first, second = (dctn(without_lines(each, known), norm="ortho") for each in (one, two))
    difference = (first - second) ** 2 / 2
    noise = difference[len(difference) // 2 :].mean(axis=0)  # by frequency along the rows, which are independent
    signal = _banded(first * second / noise) / _banded(difference / noise)
    signal[signal < CERTAIN * BANDS / np.sqrt(first.size)] = 0.0
    middle = (np.arange(BANDS) + 0.5) / (2 * BANDS)
    information = signal**2 / (1.0 + 2.0 * signal) * (middle[:, None] ** 2 + middle**2)
    whole, kept = float(information.sum()), round(KEPT * BANDS)
    return 1.0 - float(information[:kept, :kept].sum()) / whole if whole else 1.0


def _banded(power: Array) -> Array:
    for axis in (0, 1):
        starts = np.arange(BANDS) * power.shape[axis] // BANDS
        power = np.add.reduceat(power, starts, axis=axis)
    return power


def _halved(image: Image) -> tuple[Image, Array]:
    # by the lower half of its cosine transform: a mean of four pixels would fold the noise of the upper half onto it
    from scipy.fft import dctn, idctn

    values, known, cut = in_whole_blocks(image, 2)
    ny, nx = known.shape
    return Image(idctn(dctn(values, norm="ortho")[:ny, :nx], norm="ortho") / 2.0, known), cut
