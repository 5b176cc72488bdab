"""Colour maps for values, and colours that distinguish items."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

LEVELS: Final = 255
"""The number of colours of a map; the last index of a byte is reserved for unmeasured pixels."""
UNMEASURED: Final = 255

# (position, red, green, blue), linear in between; from dark to light, so that they work without colour too
_STOPS: Final[dict[str, tuple[tuple[float, int, int, int], ...]]] = {
    "gold": ((0.0, 18, 6, 4), (0.25, 92, 36, 8), (0.5, 172, 92, 22), (0.75, 232, 172, 72), (1.0, 255, 250, 224)),
    "grey": ((0.0, 8, 8, 8), (1.0, 250, 250, 250)),
    "change": ((0.0, 33, 86, 160), (0.5, 247, 247, 247), (1.0, 170, 30, 40)),
    "ice": ((0.0, 4, 8, 26), (0.3, 16, 56, 120), (0.6, 48, 132, 186), (0.85, 158, 214, 226), (1.0, 244, 252, 250)),
}
DIVERGING: Final = "change"
"""The colour map for differences: its middle means zero."""
PALETTES: Final = tuple(name for name in _STOPS if name != DIVERGING)

CATEGORICAL: Final = ("#4477AA", "#228833", "#AA3377", "#66CCEE", "#CCBB44")
"""P. Tol's bright scheme, safe for colour-blind readers. Its red is reserved for problems.

A report colours a component by its place in the list, so that no two are alike; the page by its name, before it knows
the others."""
PROBLEM: Final = "#EE6677"
NEUTRAL: Final = "#BBBBBB"


def colour_map(name: str) -> NDArray[np.uint8]:
    """Return the colours of a map from lowest to highest, shape (LEVELS, 3). Raises KeyError."""
    stops = np.array(_STOPS[name], dtype=np.float64)
    at = np.linspace(0.0, 1.0, LEVELS)
    return np.stack([np.interp(at, stops[:, 0], stops[:, i]) for i in (1, 2, 3)], axis=-1).round().astype(np.uint8)
