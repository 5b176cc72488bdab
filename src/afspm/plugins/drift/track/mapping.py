"""The mapping M_tot from tip to sample coordinates, as a homogeneous matrix.

Source: paper, supporting information, "Drift Correction Algorithm".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import Frame, Region


@dataclass(frozen=True, eq=False)
class Mapping:
    """Affine mapping x_S = M x_T from tip to sample coordinates.

    Attributes:
        matrix: 3 x 3, lengths in m, last row 0 0 1.

    Raises:
        InvalidValue: the matrix has another form, or can't be inverted.
    """

    matrix: Array

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not np.array_equal(matrix[2], (0.0, 0.0, 1.0)):
            raise InvalidValue(f"a mapping is a finite 3 x 3 matrix with the last row 0 0 1, not {matrix.tolist()}")
        if abs(np.linalg.det(matrix[:2, :2])) < 1e-6:
            raise InvalidValue(f"the mapping {matrix.tolist()} can't be inverted")
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def identity(cls) -> Mapping:
        """Return the identity, the mapping at the start of an experiment."""
        return cls(np.eye(3))

    @classmethod
    def of(cls, linear: ArrayLike, translation_m: ArrayLike) -> Mapping:
        """Return the mapping with a given 2 x 2 part and translation."""
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = linear, translation_m
        return cls(matrix)

    @classmethod
    def of_drift(cls, drift_m: ArrayLike) -> Mapping:
        """Return the translation that undoes a displacement of the sample."""
        return cls.of(np.eye(2), -np.asarray(drift_m, dtype=np.float64))

    @property
    def linear(self) -> Array:
        return self.matrix[:2, :2]

    @property
    def translation_m(self) -> Array:
        return self.matrix[:2, 2]

    @cached_property
    def inverse(self) -> Mapping:
        """Mapping from sample to tip coordinates."""
        return Mapping(np.vstack([np.linalg.inv(self.matrix)[:2], (0.0, 0.0, 1.0)]))

    def __matmul__(self, first: Mapping) -> Mapping:
        """Return the mapping that applies `first`, then this one."""
        return Mapping(self.matrix @ first.matrix)

    def apply(self, xy_m: ArrayLike) -> Array:
        """Map points, shape (..., 2), in m."""
        mapped: Array = np.asarray(xy_m, dtype=np.float64) @ self.linear.T + self.translation_m
        return mapped

    @property
    def angle_rad(self) -> float:
        """Angle, counter-clockwise, of the rotation nearest to the 2 x 2 part."""
        (a, b), (c, d) = self.linear
        return math.atan2(c - b, a + d)

    @property
    def scale(self) -> float:
        """Scale factor of lengths (square root of the determinant)."""
        return math.sqrt(abs(float(np.linalg.det(self.linear))))

    def to_sample(self, region: Region) -> Region:
        """Map a region from tip to sample coordinates.

        The result is again a rectangle: the centre is mapped, and the sides are rotated and scaled by the nearest
            similarity.
        Shear is left out, because a microscope scans rectangles.
        """
        return self._mapped(region, Frame.SAMPLE)

    def to_tip(self, region: Region) -> Region:
        """Map a region from sample to tip coordinates; see `to_sample`."""
        return self.inverse._mapped(region, Frame.TIP)

    def _mapped(self, region: Region, frame: Frame) -> Region:
        x, y = self.apply(region.center_m)
        scale, angle = self.scale, self.angle_rad
        if abs(scale - 1.0) < 1e-12:  # a translation must not change the last digits of a size
            scale = 1.0
        size_m = (region.size_m[0] * scale, region.size_m[1] * scale)
        turned = region.angle_rad + (angle if abs(angle) > 1e-15 else 0.0)
        return replace(region, center_m=(float(x), float(y)), size_m=size_m, angle_rad=turned, frame=frame)
