"""Types of arrays of measured values, and the spread of such values."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""A numpy array of 64-bit floats."""
Mask = NDArray[np.bool_]
SD_PER_MAD: Final = 1.4826
"""Standard deviation of a normal distribution, in median absolute deviations."""


def robust_spread(values: Array) -> float:
    """Return the standard deviation, estimated from the median absolute deviation; NaN if a value is NaN."""
    return SD_PER_MAD * float(np.median(np.abs(values - np.median(values))))
