"""The Tip Shaper of Nanonis: one dip of the tip and back, set up and proven before it is started."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from typing import Any, Final

from afspm.basics import ConfigError, Refused, quantity
from afspm.model import ControlResponse
from afspm.plugins.nanonis.parameter_groups import numbers
from afspm.plugins.nanonis.protocol import NanonisError, UnreadableReply

QPLUS: Final = "qplus"
SENSORS: Final = ("", QPLUS, "other")
_SAME_BIAS, _RESTORE = 2, 1
_SETTLE_S: Final = 0.1


class TipShaper:
    """The Tip Shaper, and the kind of sensor that it dips.

    Args:
        sensor: "qplus", "other", or "" if not known.
        qplus_bias_v: largest amount of the bias at which a qPlus sensor may be dipped. (! qplus-dip) Others report
            that the fork rings above 50 mV, and may be ruined.

    Raises:
        ConfigError: no such sensor.
    """

    def __init__(
        self, ask: Callable[..., tuple[Any, ...]], sensor: str, qplus_bias_v: float, log: Callable[[], logging.Logger]
    ) -> None:
        if sensor not in SENSORS:
            raise ConfigError(f"{sensor!r} is no kind of sensor", where="sensor", hint=" or ".join(SENSORS[1:]))
        self._ask, self._sensor, self._qplus_bias_v, self._log = ask, sensor, qplus_bias_v, log
        self._sensor_asked = False

    def prepare(self, depth_m: float, speed_m_s: float) -> float:
        """Set up a dip of `depth_m` and back, at the present bias, and return its duration in s.

        Raises:
            Refused: ACTION_ERROR: the module is closed, a qPlus sensor would ring, or other values are in force than
                those just set.
        """
        self._properties("nothing was sent")
        bias_v = numbers(self._ask, "Bias.Get")[0]
        self._refuse_at(bias_v)
        ramp_s = depth_m / speed_m_s
        # the tip shaper's second lift undoes the first
        ramps = (-depth_m, ramp_s, bias_v, _SETTLE_S, depth_m, ramp_s, _SETTLE_S)
        self._ask("TipShaper.PropsSet", _SETTLE_S, _SAME_BIAS, bias_v, *ramps, _RESTORE)
        *_, is_restored = found = self._properties("it was not started")
        if not is_restored or not all(map(_is_same, found[3:10], ramps)):
            values = ", ".join(f"{value:g}" for value in found)
            raise Refused(ControlResponse.ACTION_ERROR, f"the Tip Shaper has other values than those set: {values}")
        return 2 * ramp_s + 4 * _SETTLE_S

    def _properties(self, so: str) -> tuple[Any, ...]:
        try:
            return self._ask("TipShaper.PropsGet")
        except (NanonisError, UnreadableReply) as error:
            reason = f"the Tip Shaper does not answer, so {so}: open it at Nanonis ({error})"
            raise Refused(ControlResponse.ACTION_ERROR, reason) from error

    def _refuse_at(self, bias_v: float) -> None:
        if self._sensor == SENSORS[-1] or abs(bias_v) <= self._qplus_bias_v:
            return
        amounts = f"{quantity(bias_v, 'V')}, above {quantity(self._qplus_bias_v, 'V')} (qplus_bias)"
        if self._sensor == QPLUS:
            reason = f"a dip at a bias of {amounts} makes the fork of the qPlus sensor ring: lower the bias first"
            raise Refused(ControlResponse.ACTION_ERROR, reason)
        if not self._sensor_asked and any(name.startswith("OC ") for name in self._ask("Signals.NamesGet")[0]):
            self._sensor_asked = True
            text = 'a dip at a bias of %s makes the fork of a qPlus sensor ring: set sensor to "qplus" or "other"'
            self._log().warning(text, amounts)


def _is_same(found: float, wanted: float) -> bool:
    # a time may be rounded to a cycle of the controller, and a length to a step of its converters
    return math.isclose(found, wanted, rel_tol=0.01, abs_tol=1e-12)
