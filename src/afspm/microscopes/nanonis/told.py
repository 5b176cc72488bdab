"""Values as they were set, as long as the controller still has them: it keeps most as float32."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from afspm.microscopes.in_force import FRAME
from afspm.microscopes.parameters import Value
from afspm.model import names

_AS_FLOAT32: Final = 1e-6
_ADDED_UP: Final = frozenset(FRAME) - {names.SCAN_ANGLE, names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y}
"""Made of a centre and a size: the error of each is that of the largest."""


class Told:
    """What was set, by generic names."""

    def __init__(self) -> None:
        self._set: dict[str, Value] = {}

    def keep(self, values: Mapping[str, Value]) -> None:
        """These were set."""
        self._set.update(values)

    def exactly(self, got: Mapping[str, Value]) -> dict[str, Value]:
        """What the controller says, and what was set where that is the same to its precision."""
        largest = max((abs(float(got[name])) for name in _ADDED_UP & got.keys()), default=0.0)
        return {
            name: self._set[name] if name in self._set and _same(name, value, self._set[name], largest) else value
            for name, value in got.items()
        }


def _same(name: str, got: Value, set_: Value, largest: float) -> bool:
    if not (isinstance(got, float) and isinstance(set_, float)):
        return got == set_
    if name == names.SCAN_ANGLE:  # 350 degrees may come back as -10
        return abs(math.remainder(got - set_, math.tau)) <= _AS_FLOAT32 * math.tau
    return math.isclose(got, set_, rel_tol=_AS_FLOAT32, abs_tol=_AS_FLOAT32 * largest if name in _ADDED_UP else 0.0)
