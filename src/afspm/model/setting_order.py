"""The order in which settings are changed one by one while a feedback holds a current."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from afspm.model import parameter_names as names

_OF_GAP: Final = (names.TIP_BIAS_VOLTAGE, names.ZCTRL_SETPOINT)
_GAINS: Final = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)


def widening_first(now: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Return the names of `wanted` in an order that never narrows the gap beyond the narrower of both ends.

    The gap follows from |bias / setpoint|: a lower |setpoint| and a higher |bias| come first, then a higher |setpoint|
    and a lower |bias|, then all else. Gains that fall go first, gains that rise last.
    """

    def rank(name: str) -> float:
        if name not in (*_OF_GAP, *_GAINS):
            return 2.0
        rises = abs(wanted[name]) > abs(now[name])
        if name in _GAINS:
            return 3.0 if rises else -1.0
        is_bias = name == names.TIP_BIAS_VOLTAGE
        if rises == is_bias:  # it widens; of two, the setpoint first
            return 0.25 if is_bias else 0.0
        return 0.5 if is_bias else 0.75  # it narrows; of two, the bias first: a larger current is never passed

    return sorted(wanted, key=rank)
