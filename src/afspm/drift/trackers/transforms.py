"""Homogeneous matrices: what form a mapping may have, its logarithm and its exponential."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from afspm.drift.mapping import Mapping
from afspm.drift.registration import Registration

Array = NDArray[np.float64]

TRANSFORMS = ("translation", "euclidean", "similarity", "affine")


def transform_between(found: Registration, form: str) -> Mapping:
    """From tip coordinates during the reference to those during the scan, in the nearest transform of a form."""
    linear = _of_form(np.eye(2) + found.linear, form)
    center = found.center_m if form != "translation" else np.zeros(2)
    return Mapping.of(linear, center + found.displacement_m - linear @ center)


def _of_form(linear: Array, form: str) -> Array:
    """The 2 x 2 matrix of a form that is nearest (least squares of its elements)."""
    if form == "translation":
        return np.eye(2)
    if form == "affine":
        return linear
    (a, b), (c, d) = linear
    cos, sin = (a + d) / 2, (c - b) / 2
    if form == "euclidean":
        length = math.hypot(cos, sin)
        cos, sin = cos / length, sin / length
    return np.array([[cos, -sin], [sin, cos]])


def logarithm(matrix: Array) -> Array:
    """The real X with exp X = matrix, 3 x 3; of a translation exactly."""
    if np.array_equal(matrix[:2, :2], np.eye(2)):
        return np.asarray(matrix - np.eye(3))
    from scipy.linalg import logm

    return np.asarray(logm(matrix)).real


def exponential(matrix: Array) -> Array:
    """exp X with the last row 0 0 1, 3 x 3; of a translation's logarithm exactly."""
    if not matrix[:2, :2].any():
        return np.asarray(np.eye(3) + matrix)
    from scipy.linalg import expm

    made = np.asarray(expm(matrix))
    made[2] = (0.0, 0.0, 1.0)  # rounding
    return made
