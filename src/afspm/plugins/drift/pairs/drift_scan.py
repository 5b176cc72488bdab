"""A scan for the registration of a pair, and the displacement expected before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from afspm.basics import InvalidValue
from afspm.components import Array
from afspm.model import Region


@dataclass(frozen=True, eq=False)
class DriftScan:
    """One channel of a scan, in the form for estimators and trackers.

    Attributes:
        values: [y, x], both ascending; NaN for unmeasured pixels.
        region: region in tip coordinates. The first and last pixels lie on its border.
        start_s, end_s: experiment time of the first and last row.
        upwards: whether the scan began at small y; None if unknown.
        key: name of the scan, chosen by the caller.
        unit: unit of the values; empty if unknown.
    """

    values: Array
    region: Region
    start_s: float
    end_s: float
    upwards: bool | None = None
    key: str = ""
    unit: str = ""

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or min(self.values.shape) < 2:
            raise InvalidValue(f"a scan of shape {self.values.shape} can't be registered", hint="2 x 2 pixels at least")
        if not (np.isfinite((self.start_s, self.end_s)).all() and self.end_s >= self.start_s):
            raise InvalidValue(
                f"a scan needs finite times with the start before the end, not {self.start_s} s and {self.end_s} s"
            )

    @property
    def mid_s(self) -> float:
        """Middle of the scan, the time for which its position holds."""
        return (self.start_s + self.end_s) / 2

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s

    @property
    def pixel_m(self) -> tuple[float, float]:
        """Pixel spacing (x, y)."""
        ny, nx = self.values.shape
        return (self.region.size_m[0] / (nx - 1), self.region.size_m[1] / (ny - 1))


@dataclass(frozen=True, eq=False)
class Prior:
    """Displacement expected before two scans are compared.

    Attributes:
        mean_m: (2,) expected displacement.
        covariance_m2: (2, 2) covariance of the displacement.
        velocity_difference_m_s: (2,) expected drift velocity during the scan minus drift velocity during the reference;
            the difference shears one scan relative to the other.
        velocity_sd_m_s: standard deviation of each component of the difference; None if unknown: any shear is possible.
    """

    mean_m: Array
    covariance_m2: Array
    velocity_difference_m_s: Array = field(default_factory=lambda: np.zeros(2))
    velocity_sd_m_s: float | None = None
