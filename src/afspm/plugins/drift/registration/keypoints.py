"""Detection of keypoints with descriptors, by scikit-image: one function per kind of descriptor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from afspm.components import Array
from afspm.plugins.drift.pairs.images import Image


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of an image, with their descriptors.

    Attributes:
        xy_px: (n, 2) positions (x, y) from the centre of the image.
        descriptors: (n, d), with a small Euclidean distance for similar surroundings.
    """

    xy_px: Array
    descriptors: Descriptors

    def __len__(self) -> int:
        return len(self.xy_px)


def brief(image: Image, count_max: int) -> Keypoints:
    """Return Harris corners with binary descriptors of 256 comparisons within 49 px (Calonder et al. 2010)."""
    feature = _skimage()
    response = feature.corner_harris(image.values, sigma=1.0)
    corners = feature.corner_peaks(response, min_distance=1, threshold_rel=0.0, num_peaks=count_max)
    corners = corners[_known(image, corners, 3.0)]
    extractor = feature.BRIEF(descriptor_size=256, patch_size=49, mode="normal", sigma=1.0, rng=1)
    # The patch of a corner near the border reaches beyond the scan: mirrored there, no corner is lost.
    margin = 25
    extractor.extract(np.pad(image.values, margin, mode="reflect"), corners + margin)
    kept = corners[extractor.mask]
    return _keypoints(image, _sharpened(response, kept), _signs(extractor.descriptors))


def orb(image: Image, count_max: int) -> Keypoints:
    """Return FAST corners at several scales, with rotation-invariant binary descriptors (Rublee et al. 2011)."""
    detector = _skimage().ORB(n_keypoints=count_max, fast_threshold=0.05)
    if not _found(detector.detect_and_extract, _unit(image.values)):
        return _none(256)
    inside = _known(image, detector.keypoints, 5.0)
    return _keypoints(image, detector.keypoints[inside], _signs(detector.descriptors[inside]))


def sift(image: Image, count_max: int) -> Keypoints:
    """Return blobs at several scales, with gradient histograms as descriptors (Lowe 2004)."""
    detector = _skimage().SIFT()
    values = _unit(image.values)
    if not _found(detector.detect, values):
        return _none(128)
    # descriptors take most of the time, so only the kept keypoints get descriptors
    kept = _strongest_blobs(image.values, detector, count_max)
    kept = kept[_known(image, detector.positions[kept], 2.0 * detector.sigmas[kept])]
    for name in ("keypoints", "positions", "sigmas", "scales", "orientations", "octaves"):
        setattr(detector, name, getattr(detector, name)[kept])
    if not len(kept):
        return _none(128)
    detector.extract(values)
    return _keypoints(image, detector.positions, detector.descriptors.astype(np.float32))


KINDS = {"brief": brief, "orb": orb, "sift": sift}


def _skimage() -> ModuleType:
    from skimage import feature

    return feature


def _keypoints(image: Image, rows_columns: np.ndarray, descriptors: Descriptors) -> Keypoints:
    middle = (np.array(image.values.shape) - 1) / 2
    return Keypoints((np.asarray(rows_columns, dtype=np.float64) - middle)[:, ::-1], descriptors)


def _found(detect: Callable[[Array], None], values: Array) -> bool:
    # scikit-image raises if it finds nothing
    try:
        detect(values)
    except RuntimeError:
        return False
    return True


def _none(length: int) -> Keypoints:
    return Keypoints(np.empty((0, 2)), np.empty((0, length), dtype=np.float32))


def _unit(values: Array) -> Array:
    # thresholds of scikit-image mean values between 0 and 1
    low, high = float(values.min()), float(values.max())
    return (values - low) / ((high - low) or 1.0)


def _signs(bits: np.ndarray) -> Descriptors:
    # ±1/2: the squared Euclidean distance is then the number of differing bits
    signs: Descriptors = np.where(bits, 0.5, -0.5).astype(np.float32)
    return signs


def _known(image: Image, rows_columns: np.ndarray, reach_px: float | np.ndarray) -> NDArray[np.bool_]:
    # a border pulls at keypoints near it, so all pixels within reach must be measured
    away = ndimage.distance_transform_edt(np.pad(image.known, 1))[1:-1, 1:-1]
    at = np.rint(rows_columns).astype(int).clip(0, np.array(image.values.shape) - 1)
    inside: NDArray[np.bool_] = away[at[:, 0], at[:, 1]] > reach_px
    return inside


def _sharpened(response: Array, corners: np.ndarray) -> Array:
    padded = np.pad(response, 1, mode="edge")
    row, column = corners[:, 0] + 1, corners[:, 1] + 1
    position = corners.astype(np.float64)
    for axis, (step_row, step_column) in enumerate(((1, 0), (0, 1))):
        before = padded[row - step_row, column - step_column]
        after = padded[row + step_row, column + step_column]
        bend = before - 2 * padded[row, column] + after
        top = np.where(bend < 0.0, 0.5 * (before - after) / np.where(bend < 0.0, bend, 1.0), 0.0)
        position[:, axis] += np.clip(top, -0.5, 0.5)
    return position


class _Blobs(Protocol):
    # what scikit-image's SIFT has found
    positions: Array  # (row, column) of each
    sigmas: Array


def _strongest_blobs(values: Array, detector: _Blobs, count_max: int) -> NDArray[np.intp]:
    count = len(detector.positions)
    if count <= count_max:
        return np.arange(count)
    contrast = np.zeros(count)
    size = np.exp2(np.rint(np.log2(detector.sigmas)))
    at = np.rint(detector.positions).astype(int).clip(0, np.array(values.shape) - 1)
    for sigma in np.unique(size):
        here = size == sigma
        laplacian = sigma**2 * ndimage.gaussian_laplace(values, float(sigma))
        contrast[here] = np.abs(laplacian[at[here, 0], at[here, 1]])
    return np.sort(np.argsort(-contrast, kind="stable")[:count_max])


Descriptors = NDArray[np.float32]
Allowed = Callable[[slice], NDArray[np.bool_]]

_CELLS = 1 << 20  # largest size of the table of distances in memory: 4 MB


def matched(first: Descriptors, second: Descriptors, allowed: Allowed | None = None) -> NDArray[np.intp]:
    """Return pairs of descriptors that are mutual nearest neighbours by Euclidean distance.

    Of equally near descriptors the first counts.

    Args:
        first, second: descriptors, (n, d) and (m, d).
        allowed: for a slice of `first`, the mask (rows, m) of allowed pairs.

    Returns:
        Row numbers (k, 2), in the order of `first`.
    """
    if not len(first) or not len(second):
        return np.empty((0, 2), dtype=np.intp)
    lengths = (second**2).sum(axis=1)
    nearest = np.empty(len(first), dtype=np.intp)
    back = np.zeros(len(second), dtype=np.intp)
    back_distance = np.full(len(second), np.inf, dtype=np.float32)
    possible = np.empty(len(first), dtype=np.bool_)
    step = max(_CELLS // len(second), 1)
    for start in range(0, len(first), step):
        rows = slice(start, min(start + step, len(first)))
        distance = (first[rows] ** 2).sum(axis=1)[:, None] + lengths - 2.0 * first[rows] @ second.T
        if allowed is not None:
            distance[~allowed(rows)] = np.inf
        nearest[rows] = distance.argmin(axis=1)
        possible[rows] = np.isfinite(distance.min(axis=1))
        column = distance.argmin(axis=0)
        least = distance[column, np.arange(len(second))]
        better = least < back_distance
        back[better], back_distance[better] = column[better] + start, least[better]
    mutual = (back[nearest] == np.arange(len(first))) & possible
    found = np.flatnonzero(mutual)
    return np.stack([found, nearest[found]], axis=1)
