"""Parameters that Nanonis groups, scales or signs in ways that a table can't express; frame and tip: see `geometry`.

Values of a group are read together and written together, by generic names, in SI. Where `…Get` and `…Set` count
differently, values are converted ("Traps" in the README).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from afspm.basics import Refused
from afspm.driver import FEEDBACK_ON, SettingsGroup, Value, refuse_value
from afspm.model import ControlResponse, names
from afspm.plugins.nanonis.protocol import NanonisError, UnreadableReply

Ask = Callable[..., tuple[Any, ...]]

DRIFT_RATE_X: Final = "x-drift-rate-x"
DRIFT_RATE_Y: Final = "x-drift-rate-y"

_ON, _OFF = 1, 2
"""Values of a switch in `…Set`; `…Get` returns 1 and 0 instead."""
_DRIFT_WITHOUT_LIMIT: Final = 7
"""Number of results of Piezo.DriftCompGet in release 2021."""
_CONTROLLER_OFF, _SAFE_TIP, _WITHDRAWING = 1, 5, 6
"""Values of ZCtrl.StatusGet; the others are on, on hold and switching off."""
_KNOWN: Final = range(_CONTROLLER_OFF, _WITHDRAWING + 1)
_END_OF_RANGE: Final = 1e-3
"""Distance from the upper limit of z, as a part of the range, within which the tip counts as withdrawn: more than its
noise."""
_KEEP_SPEED: Final = 1
"""Value of Scan.SpeedSet for the quantity that a change of the frame keeps; Scan.SpeedGet returns 0 instead."""


class Group(SettingsGroup):
    """A group of parameters that Nanonis reads and writes together."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask

    def _numbers(self, name: str, *arguments: object) -> tuple[Any, ...]:
        return numbers(self._ask, name, *arguments)


class SideGroup(SettingsGroup):
    """A group without which scans are possible: an answer that can't be read costs its values, not the contact.

    Attributes:
        unreadable: why the last answer could not be read; otherwise empty.
    """

    def __init__(self, group: Group, log: Callable[[], logging.Logger]) -> None:
        self.names = group.names
        self._group, self._log, self._logged, self.unreadable = group, log, "", ""

    def read(self) -> dict[str, Value]:
        try:
            found = self._group.read()
        except UnreadableReply as error:
            self.unreadable = str(error)
            what = f"{', '.join(self.names)}: not supported while Nanonis' answer can't be read"
            if self._logged != self.unreadable:
                self._logged = self.unreadable
                self._log().warning("%s: %s", what, error)
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, f"{what}: {error}") from error
        self.unreadable = ""
        return found

    def write(self, values: Mapping[str, Value]) -> None:
        self._group.write(values)


def numbers(ask: Ask, name: str, *arguments: object) -> tuple[Any, ...]:
    """Return the results of a function whose numbers must be finite.

    Raises:
        UnreadableReply: a number is infinite or NaN.
    """
    found = ask(name, *arguments)
    for value in found:
        if isinstance(value, float) and not math.isfinite(value):
            raise UnreadableReply(f"Nanonis returned {value} in reply to {name}")
    return found


def keep_speed(ask: Ask) -> tuple[float, float]:
    """Let Nanonis keep both scan speeds when the frame changes, instead of the time per line.

    Returns:
        the speeds forward and backward, in m/s.
    """
    *speeds, keeps_time, ratio = ask("Scan.SpeedGet")
    if keeps_time:
        ask("Scan.SpeedSet", *speeds, _KEEP_SPEED, ratio)
    return float(speeds[0]), float(speeds[1])


def set_speed(ask: Ask, forward_m_s: float, backward_m_s: float, width_m: float) -> None:
    """Set both scan speeds, with the times per line of a frame of this width."""
    times_s = width_m / forward_m_s, width_m / backward_m_s
    ask("Scan.SpeedSet", forward_m_s, backward_m_s, *times_s, _KEEP_SPEED, backward_m_s / forward_m_s)


class ScanSpeed(Group):
    """The forward scan speed in m/s. The backward speed keeps its ratio to the forward speed.

    Nanonis keeps both speeds when the frame changes, instead of the time per line (`keep_speed`).
    """

    names = (names.SCAN_SPEED,)

    def read(self) -> dict[str, Value]:
        return {names.SCAN_SPEED: self._numbers("Scan.SpeedGet")[0]}

    def write(self, values: Mapping[str, Value]) -> None:
        forward_m_s = float(values[names.SCAN_SPEED])
        *_, ratio = self._numbers("Scan.SpeedGet")
        width_m = self._numbers("Scan.FrameGet")[2]
        backward_m_s = forward_m_s * ratio
        if min(forward_m_s, backward_m_s) <= 0.0:
            raise refuse_value(
                names.SCAN_SPEED,
                f"the speeds forward and backward must be above 0, not {forward_m_s:g} and {backward_m_s:g} m/s",
            )
        set_speed(self._ask, forward_m_s, backward_m_s, width_m)


class Gains(Group):
    """The gains of the z controller: Nanonis has P, the time constant T, and I = P / T."""

    names = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)

    def read(self) -> dict[str, Value]:
        proportional, _, integral = self._ask("ZCtrl.GainGet")  # not `_numbers`: T is infinite without I
        return {names.ZCTRL_PGAIN: proportional, names.ZCTRL_IGAIN: integral}

    def write(self, values: Mapping[str, Value]) -> None:
        merged = self.merged(values)
        proportional, integral = float(merged[names.ZCTRL_PGAIN]), float(merged[names.ZCTRL_IGAIN])
        if proportional <= 0.0 or integral <= 0.0:
            reason = "both must be above 0: Nanonis sets the time constant T = P / I"
            raise refuse_value(f"{names.ZCTRL_PGAIN}, {names.ZCTRL_IGAIN}", reason)
        self._ask("ZCtrl.GainSet", proportional, proportional / integral, integral)


class FeedbackOn(Group):
    """The switch of the z controller, as reported by its real-time part, which follows a setting with a delay.

    Args:
        wait_for: waits for a condition, up to a time limit.
    """

    names = (FEEDBACK_ON,)

    def __init__(self, ask: Ask, wait_for: Callable[[Callable[[], bool]], bool]) -> None:
        super().__init__(ask)
        self._wait_for = wait_for

    def read(self) -> dict[str, Value]:
        return {FEEDBACK_ON: self._ask("ZCtrl.OnOffGet")[0] == 1}

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = bool(values[FEEDBACK_ON])
        self._ask("ZCtrl.OnOffSet", int(wanted))
        # OnOffGet reports the real-time controller, which follows with a delay.
        self._wait_for(lambda: self.read()[FEEDBACK_ON] is wanted)


class TipState(Group):
    """The z controller's report on the tip: withdrawn or not.

    Nanonis reports a withdrawal only while it lasts; until its end nothing shows whether a person or the safe tip
    withdraws the tip. Afterwards the controller is off, with the tip at the upper limit of z. A tip that is held
    elsewhere with the controller off is not withdrawn.

    Attributes:
        is_safe: whether the safe tip had withdrawn the tip at the last reading.
        is_withdrawing: whether the tip was on its way up at the last reading.
        is_undecided: whether it was so at the last reading, or when `x-engaged` was read.
    """

    names = (names.ENGAGED,)

    def __init__(self, ask: Ask, log: Callable[[], logging.Logger]) -> None:
        super().__init__(ask)
        self._log, self._told = log, set[object]()
        self.is_safe = self.is_withdrawing = self._was_withdrawing = False

    @property
    def is_undecided(self) -> bool:
        # a withdrawal may end right after `x-engaged` was read: the value in force is still the one from before
        return self.is_withdrawing or self._was_withdrawing

    def look(self) -> int:
        """Read the status of the z controller, which sets the attributes, and return it."""
        status = int(self._ask("ZCtrl.StatusGet")[0])
        if status not in _KNOWN and status not in self._told:
            self._told.add(status)
            self._log().warning("Nanonis' z controller has the status %d, which no document names (1 to 6)", status)
        self.is_safe, self.is_withdrawing = status == _SAFE_TIP, status == _WITHDRAWING
        return status

    def read(self) -> dict[str, Value]:
        status = self.look()
        self._was_withdrawing = self.is_withdrawing
        is_away = self.is_safe or (status == _CONTROLLER_OFF and self._is_at_upper_limit())
        return {names.ENGAGED: not is_away}

    def write(self, values: Mapping[str, Value]) -> None:
        raise refuse_value(names.ENGAGED, "it is read-only")

    def _is_at_upper_limit(self) -> bool:
        try:
            high_m, low_m = self._numbers("ZCtrl.LimitsGet")
            z_m = self._numbers("ZCtrl.ZPosGet")[0]
        except (NanonisError, UnreadableReply) as error:
            if str(error) not in self._told:
                self._told.add(str(error))
                self._log().warning("a withdrawn tip counts as engaged, since its place is not known: %s", error)
            return False
        return bool(z_m >= high_m - _END_OF_RANGE * (high_m - low_m))


class SafeTip(Group):
    """The controller's own guard: whether it is on, and the signal at which it withdraws the tip."""

    names = (names.SAFE_TIP_ON, names.SAFE_TIP_THRESHOLD)

    def read(self) -> dict[str, Value]:
        try:
            (is_on,), (*_, threshold_a) = self._ask("SafeTip.OnOffGet"), self._numbers("SafeTip.PropsGet")
        except NanonisError as error:
            raise Refused(
                ControlResponse.PARAM_NOT_SUPPORTED, f"Nanonis does not report its safe tip: {error}"
            ) from error
        return dict(zip(self.names, (is_on == 1, threshold_a), strict=True))  # (! safe-tip)

    def write(self, values: Mapping[str, Value]) -> None:
        raise refuse_value(next(iter(values)), "it is read-only")


class MoveSpeed(Group):
    """The speed of the tip between scans; a setting makes this speed independent of the scan speed."""

    names = (names.MOVE_SPEED,)

    def read(self) -> dict[str, Value]:
        # Without a speed of its own, the tip moves at the scan speed between scans, too.
        speed_m_s, own = self._numbers("FolMe.SpeedGet")
        return {names.MOVE_SPEED: speed_m_s if own else self._numbers("Scan.SpeedGet")[0]}

    def write(self, values: Mapping[str, Value]) -> None:
        own = 1
        self._ask("FolMe.SpeedSet", float(values[names.MOVE_SPEED]), own)


class Slope(Group):
    """The compensation of the sample's tilt as slopes, converted from Nanonis' angles in degrees."""

    names = (names.SAMPLE_SLOPE_X, names.SAMPLE_SLOPE_Y)

    def read(self) -> dict[str, Value]:
        angles_deg = self._numbers("Piezo.TiltGet")
        return {name: math.tan(math.radians(deg)) for name, deg in zip(self.names, angles_deg, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        merged = self.merged(values)
        self._ask("Piezo.TiltSet", *(math.degrees(math.atan(float(merged[name]))) for name in self.names))


class DriftRate(Group):
    """The velocities in x and y of the controller's drift compensation, which is off if all velocities are 0.

    The z velocity in force is kept. An axis stops at a share of the piezo's range, and its velocity is still reported.
    Another velocity would have no effect then, and is refused.
    """

    names = (DRIFT_RATE_X, DRIFT_RATE_Y)
    _usual_limit_percent: ClassVar[float] = 10.0

    def read(self) -> dict[str, Value]:
        on, *rates_m_s = self._numbers("Piezo.DriftCompGet")[:3]
        return {name: rate if on else 0.0 for name, rate in zip(self.names, rates_m_s, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        on, _, _, up_m_s, *stopped, _, limit_percent = self._with_limit(self._numbers("Piezo.DriftCompGet"))
        for name, is_stopped in zip(self.names, stopped, strict=True):
            if on and is_stopped and values.get(name):
                raise refuse_value(
                    name,
                    f"drift compensation has reached its limit of {limit_percent:g} % of the piezo's range and stopped "
                    "along this axis; switch it off and on at the controller to begin again",
                )
        merged = self.merged(values)
        x, y = (float(merged[name]) for name in self.names)
        # while it is off, a velocity left from earlier is not in force, and must not come into force unasked
        up_m_s = up_m_s if on else 0.0
        follows = bool(x or y or up_m_s)
        self._ask("Piezo.DriftCompSet", _ON if follows else _OFF, x, y, up_m_s, limit_percent)

    def _with_limit(self, found: tuple[Any, ...]) -> tuple[Any, ...]:
        # release 2021 has no limit
        return found if len(found) > _DRIFT_WITHOUT_LIMIT else (*found, self._usual_limit_percent)


class SweptBias(Group):
    """First and last bias of bias spectroscopy, unless it sweeps the segments of a table."""

    names = names.SPEC_ENDS
    _linear: ClassVar = "Linear"

    def read(self) -> dict[str, Value]:
        try:
            (mode,) = self._ask("BiasSpectr.MLSModeGet")
        except NanonisError:  # a release without segments
            mode = self._linear
        if mode != self._linear:
            reason = f"bias spectroscopy sweeps the segments of its table ({mode}): set it to {self._linear}"
            raise Refused(ControlResponse.PARAM_NOT_SUPPORTED, reason)
        return dict(zip(self.names, self._numbers("BiasSpectr.LimitsGet"), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        merged = self.merged(values)
        self._ask("BiasSpectr.LimitsSet", *(float(merged[name]) for name in self.names))


class SweptHeight(Group):
    """First and last height of z spectroscopy: Nanonis has the offset of the first, and the way from there.

    (! z-sweep-sign)
    """

    names = names.SPEC_Z_ENDS

    def read(self) -> dict[str, Value]:
        offset_m, way_m = self._numbers("ZSpectr.RangeGet")
        return dict(zip(self.names, (offset_m, offset_m + way_m), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        first_m, last_m = (float(self.merged(values)[name]) for name in self.names)
        self._ask("ZSpectr.RangeSet", first_m, last_m - first_m)


class OfKind(Group):
    """A group of values of a curve, for the kind of curve in force.

    Args:
        module: returns the module of this kind.
    """

    _time_at: ClassVar = {"BiasSpectr": 5, "ZSpectr": 4}
    _offset_at: ClassVar = 1  # of BiasSpectr.TimingGet

    def __init__(self, ask: Ask, module: Callable[[], str]) -> None:
        super().__init__(ask)
        self._module = module


class CurveTiming(OfKind):
    """The time to measure each point of a curve, and the height at which it is taken."""

    names = (names.SPEC_POINT_TIME, names.SPEC_Z_OFFSET)

    def read(self) -> dict[str, Value]:
        module = self._module()
        timing = self._ask(f"{module}.TimingGet")  # not `_numbers`: the slew rate may be infinite
        is_bias = module == "BiasSpectr"
        offset_m = timing[self._offset_at] if is_bias else self._numbers("ZSpectr.RangeGet")[0]
        return dict(zip(self.names, (timing[self._time_at[module]], offset_m), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        module = self._module()
        if module == "ZSpectr" and names.SPEC_Z_OFFSET in values:
            raise refuse_value(names.SPEC_Z_OFFSET, f"a curve of the height begins at {names.SPEC_Z_FROM}: set that")
        timing = list(self._ask(f"{module}.TimingGet"))
        timing[self._time_at[module]] = float(values.get(names.SPEC_POINT_TIME, timing[self._time_at[module]]))
        if module == "BiasSpectr":
            timing[self._offset_at] = float(values.get(names.SPEC_Z_OFFSET, timing[self._offset_at]))
        self._ask(f"{module}.TimingSet", *timing)


class CurvePoints(OfKind):
    """The number of points of a curve, and whether Nanonis saves curves. (! curve-layout)"""

    names = (names.SPEC_POINTS,)
    _points_at: ClassVar = {"BiasSpectr": 3, "ZSpectr": 1}
    _saves_at: ClassVar = {"BiasSpectr": 6, "ZSpectr": 5}
    _with_saves: ClassVar = 8
    """Number of results of PropsGet in the layout that reports autosave."""

    def read(self) -> dict[str, Value]:
        module = self._module()
        return {names.SPEC_POINTS: self._ask(f"{module}.PropsGet")[self._points_at[module]]}

    def write(self, values: Mapping[str, Value]) -> None:
        self._set(points=int(values[names.SPEC_POINTS]))

    def _set(self, *, points: int = 0, saves: int = 0, dialog: int = 0) -> None:
        # 0 is no change, except for the offset
        if self._module() == "BiasSpectr":
            offset_m = self._ask("BiasSpectr.TimingGet")[self._offset_at]
            self._ask("BiasSpectr.PropsSet", 0, 0, 0, points, offset_m, saves, dialog)
        else:
            self._ask("ZSpectr.PropsSet", 0, points, 0, saves, dialog, 0)

    def save(self, *, switch_on: bool) -> bool | None:
        """Return whether Nanonis saves the next curve; None: it does not report that. See `switch_on`.

        Args:
            switch_on: whether saving is switched on, unless it is on.
        """
        saves = self._saves()
        if switch_on and not saves:
            # a dialog that waits on the screen would stop the whole interface
            self._set(saves=_ON, dialog=_OFF)
            saves = self._saves()
        return saves

    def _saves(self) -> bool | None:
        module = self._module()
        found = self._ask(f"{module}.PropsGet")
        return bool(found[self._saves_at[module]]) if len(found) == self._with_saves else None


class LockIn(Group):
    """Amplitude and frequency of the first modulator of the lock-in amplifier."""

    names = (names.LOCK_IN_AMPLITUDE, names.LOCK_IN_FREQUENCY)
    _functions: ClassVar = dict(zip(names, ("LockIn.ModAmp", "LockIn.ModPhasFreq"), strict=True))
    _first: ClassVar = 1

    def read(self) -> dict[str, Value]:
        return {name: self._numbers(f"{function}Get", self._first)[0] for name, function in self._functions.items()}

    def write(self, values: Mapping[str, Value]) -> None:
        for name, value in values.items():
            self._ask(f"{self._functions[name]}Set", self._first, float(value))
