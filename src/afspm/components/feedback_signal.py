"""Error of the feedback in a scan, from the height and the channel that the feedback holds at the setpoint."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from afspm.basics import RequestError, same_kind
from afspm.basics.errors import ConfigError, InvalidValue, Refused, UnitError
from afspm.basics.units import Length, convert
from afspm.client.component import Component
from afspm.client.scope import Scope
from afspm.components.feedback_metrics import FeedbackError, FeedbackLimits, feedback_error, relative_error
from afspm.model import HEIGHT, ChannelName, Scan, names

ASKED_WITHIN_S = 5.0  # for an answer of the microscope; without one the unit is not known yet

_THRESHOLD = 0.1
_CURRENT_THRESHOLD = 0.5  # of the logarithm: 25 pm
_M_PER_V = 50e-9  # usual for the light lever of a cantilever
_CURRENT_DECAY_M = 0.05e-9  # a tenth of the current for 0.1 nm: work functions of some eV


_HELD = {"V": "amplitude", "A": "current", "Hz": "frequency shift", "m": "amplitude"}
"""The signal that the feedback holds, by the unit of its setpoint."""


class FeedbackSignal:
    """The comparison of a channel with the setpoint.

    The first scan in each unit causes a request to the microscope: whether it can return the setpoint in that unit. A
    channel in m is compared with a setpoint in V by the sensitivity, if it is given.

    Args:
        threshold: error above which a pixel is bad, as a share of the setpoint (of a current: as a difference of
            logarithms); None: 0.1, and 0.5 for a current.
        sensitivity: height in m for 1 V of the channel, or, for a current, for a factor e; None: 50 nm, and 0.05 nm.
    """

    def __init__(self, threshold: float | None, sensitivity: float | None) -> None:
        if threshold is not None and not threshold > 0.0:
            raise ConfigError(f"{threshold!r} is not above zero", where="threshold")
        if sensitivity == 0.0:
            raise ConfigError("a sensitivity of zero", where="sensitivity")
        self._threshold, self._sensitivity = threshold, sensitivity
        self._reasons: dict[str, str] = {}

    def error(self, signal: Scan, height: Scan | None, setpoint: float | None, scope: Scope) -> FeedbackError:
        """Return the error of one scan.

        Raises:
            InvalidValue: the channel's unit does not fit the setpoint (an amplitude in m where the setpoint is in V),
                the translator does not answer at present, the channel has no value, the setpoint is zero, or `height`
                is not in a unit of length or differs in pixels.
        """
        if setpoint is not None and self._is_calibrated(signal, scope):
            setpoint *= abs(self._sensitivity or 0.0) / convert(1.0, signal.unit, "m")
        elif setpoint is not None:
            if signal.unit not in self._reasons:
                self._reasons[signal.unit] = self._reason(signal, scope)
            if reason := self._reasons[signal.unit]:
                raise InvalidValue(f"{signal.channel} can't be compared with the setpoint: {reason}")
            if (unit := scope.feedback_units.setpoint) and same_kind(unit, signal.unit):
                setpoint = convert(setpoint, unit, signal.unit)  # a file may have nA where the setpoint is in A
        is_current = same_kind(signal.unit, "A")
        error = relative_error(signal.values, setpoint, is_current)
        threshold = self._threshold or (_CURRENT_THRESHOLD if is_current else _THRESHOLD)
        if height is None:
            return feedback_error(error, threshold)
        try:
            height_m = height.values * convert(1.0, height.unit, "m")
        except UnitError as wrong:
            raise InvalidValue(f"{height.channel} is not a height: {wrong.what}") from wrong
        if height_m.shape != error.shape:
            raise InvalidValue(f"{height.channel} and {signal.channel} differ in pixels")
        return feedback_error(error, threshold, height_m, self._gap_m(signal, setpoint))

    def _is_calibrated(self, signal: Scan, scope: Scope) -> bool:
        # An amplitude in m, with the setpoint in V: the height for 1 V is the amplitude of 1 V.
        in_volts = bool(scope.feedback_units.setpoint) and same_kind(scope.feedback_units.setpoint, "V")
        return self._sensitivity is not None and in_volts and same_kind(signal.unit, "m")

    def _gap_m(self, signal: Scan, setpoint: float | None) -> float:
        # 0 where the gap per relative error is not known.
        if same_kind(signal.unit, "A"):
            return -(self._sensitivity or _CURRENT_DECAY_M)
        unit, metres = ("m", 1.0) if same_kind(signal.unit, "m") else ("V", self._sensitivity or _M_PER_V)
        if not same_kind(signal.unit, unit):
            return 0.0
        held = setpoint if setpoint is not None else float(np.nanmedian(signal.values))
        return abs(held) * convert(1.0, signal.unit, unit) * metres

    def _reason(self, scan: Scan, scope: Scope) -> str:
        try:
            scope.get(names.ZCTRL_SETPOINT, scan.unit, timeout_s=ASKED_WITHIN_S)
        except UnitError as error:
            return error.what
        except Refused:  # the setpoint can't be read, so nothing contradicts the channel's unit
            return ""
        except RequestError as error:
            raise InvalidValue(f"its unit is not known yet: {error.what}") from error
        return ""


class FeedbackObserver(Component):
    """Base of components that judge the feedback by its error signal in scans.

    Args:
        channel: the signal that the feedback holds at the setpoint, by role or name; None: by the unit of the setpoint
            the amplitude, the current or the frequency shift.
        height: the channel of the heights; empty if not recorded: then a slightly slow feedback is not detected.
        threshold: error above which a pixel is bad, as a share of the setpoint (of a current: as a difference of
            logarithms); by default 0.1, and 0.5 for a current.
        limit: largest share of bad pixels with a good feedback.
        relief_limit: share of the relief that may be in the error instead of the height.
        sensitivity: height for 1 V of the channel, or, for a current, for a factor of 2.7; by default 50 nm, and 50 pm.
            Negative if the signal falls as the tip withdraws, as a deflection does. A channel in metres needs it where
            the setpoint is in V.
    """

    def __init__(
        self,
        channel: ChannelName | None = None,
        height: Annotated[ChannelName, HEIGHT] = HEIGHT,
        threshold: float | None = None,
        limit: float = FeedbackLimits.pixels,
        relief_limit: float = FeedbackLimits.relief,
        sensitivity: Length | None = None,
    ) -> None:
        if not (0.0 < limit < 1.0 and relief_limit > 0.0):
            raise ConfigError("`limit` must be between 0 and 1, `relief_limit` above zero")
        self.channel, self.height = channel, height
        self.limits = FeedbackLimits(limit, relief_limit)
        self.signal = FeedbackSignal(threshold, sensitivity)

    def held_channel(self) -> str:
        """Return the signal that the feedback holds, by role or name.

        Raises:
            InvalidValue: no channel is named, and the unit of the setpoint does not tell it.
        """
        unit = self.scope.feedback_units.setpoint
        found = self.channel or next((role for kind, role in _HELD.items() if unit and same_kind(unit, kind)), None)
        if found is None:
            what = f"the unit of the setpoint, {unit!r}, does not tell which signal the feedback holds"
            raise InvalidValue(what, where="channel", hint='name it: channel = "deflection"')
        return found
