"""The order in which settings are changed one by one while a feedback holds a current."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from afspm.model import parameter_names as names

_OF_GAP: Final = (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT)


def widening_first(now: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Return the names of `wanted` in an order that never narrows the gap beyond the narrower of both ends.

    The gap follows from |bias / setpoint|: a lower |setpoint| and a higher |bias| come first, then a higher |setpoint|
    and a lower |bias|, then all else.
    """

    def rank(name: str) -> int:
        if name not in _OF_GAP:
            return 2
        rises = abs(wanted[name]) > abs(now[name])
        return int(rises != (name == names.TIP_BIAS_VOLTAGE))

    return sorted(wanted, key=rank)
