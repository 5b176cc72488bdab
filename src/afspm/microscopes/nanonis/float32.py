"""When two values are the same to a controller that keeps most as float32."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from afspm.model import names
from afspm.translator.parameters import Value
from afspm.translator.settings import FRAME

_DIGITS: Final = 1e-6
_ADDED_UP: Final = frozenset(FRAME) - {names.SCAN_ANGLE, names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y}
"""Made of a centre and a size: the error of each is that of the largest."""


def same_float32(name: str, got: Value, other: Value, among: Mapping[str, Value]) -> bool:
    """Whether a value that was got is another one.

    Args:
        among: what was got with it: of a frame, all.
    """
    if not (isinstance(got, float) and isinstance(other, float)):
        return got == other
    if name == names.SCAN_ANGLE:  # 350 degrees may come back as -10
        return abs(math.remainder(got - other, math.tau)) <= _DIGITS * math.tau
    largest = max(abs(float(among[part])) for part in _ADDED_UP & among.keys()) if name in _ADDED_UP else 0.0
    return math.isclose(got, other, rel_tol=_DIGITS, abs_tol=_DIGITS * largest)
