"""Parameters that Nanonis groups, scales or signs in ways that a table can't express.

A group is read by one request and written by one command, by generic names, in SI. Values of a `…Get` are never passed
to a `…Set` as they are where both count differently (the table of `protocol`, "Traps" in the README).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from afspm.basics.formatting import lengths_text
from afspm.model import Region, names
from afspm.plugins.nanonis.protocol import BadReply
from afspm.translator.parameters import FEEDBACK_ON, Value, refuse_value
from afspm.translator.setting_groups import FRAME, POSITION, SettingsGroup, frame, frame_values

Ask = Callable[..., tuple[Any, ...]]

DRIFT_RATE_X: Final = "x-drift-rate-x"
DRIFT_RATE_Y: Final = "x-drift-rate-y"

_PIXELS_AT_ONCE: Final = 16
_DIGITS: Final = 1e-6  # relative precision of float32, with a margin
_ADDED_UP: Final = frozenset(FRAME) - {names.SCAN_ANGLE, names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y}
"""Parameters calculated from centre and size: their absolute error is the largest one's."""
_ON, _OFF = 1, 2
"""In `…Set`; `…Get` returns 1 and 0 instead."""


class Group(SettingsGroup):
    """Parameters read by one request and written by one command."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask

    def _numbers(self, name: str, *arguments: object) -> tuple[Any, ...]:
        return numbers(self._ask, name, *arguments)


def numbers(ask: Ask, name: str, *arguments: Any) -> tuple[Any, ...]:
    """Return the numbers that a function replies.

    Raises:
        BadReply: a number is not finite, so that nothing can be set by it.
    """
    found = ask(name, *arguments)
    for value in found:
        if isinstance(value, float) and not math.isfinite(value):
            raise BadReply(f"Nanonis returned {value} in reply to {name}")
    return found


class ScanFrame(Group):
    """The scan frame: Nanonis has the centre, a clockwise angle in degrees, and the range of N pixels of range / N."""

    names = FRAME

    def read(self) -> dict[str, Value]:
        _, columns, rows = self._ask("Scan.BufferGet")
        x, y, width, height, clockwise_deg = self._numbers("Scan.FrameGet")
        if min(columns, rows) < 1 or min(width, height) <= 0.0:
            raise BadReply(
                f"Nanonis returned a frame of {lengths_text((width, height), ' x ')} with {columns} x {rows} pixels"
            )
        size_m = (width * _share(columns), height * _share(rows))
        return frame_values(Region((x, y), size_m, 0.0 - math.radians(clockwise_deg)), (rows, columns))

    def write(self, values: Mapping[str, Value]) -> None:
        region, (rows, columns) = frame(self.merged(values))
        # Nanonis would round the number of pixels without a word
        if columns % _PIXELS_AT_ONCE:
            below = max(columns // _PIXELS_AT_ONCE, 1) * _PIXELS_AT_ONCE
            raise refuse_value(
                names.SCAN_RESOLUTION_X,
                f"Nanonis scans multiples of {_PIXELS_AT_ONCE} pixels a line: "
                f"{below} or {below + _PIXELS_AT_ONCE}, not {columns}",
            )
        if names.SCAN_RESOLUTION_X in values or names.SCAN_RESOLUTION_Y in values:
            self._ask("Scan.BufferSet", self._ask("Scan.BufferGet")[0], columns, rows)
        width, height = region.size_m
        self._ask(
            "Scan.FrameSet",
            *region.center_m,
            width / _share(columns),
            height / _share(rows),
            0.0 - math.degrees(region.angle_rad),
        )


def _share(pixels: int) -> float:
    # Nanonis' range goes from edge to edge of the pixels, afspm's from centre to centre.
    return (pixels - 1) / pixels if pixels > 1 else 1.0


class ScanSpeed(Group):
    """The scan speed forward. The backward speed keeps its ratio; the speeds are kept when the frame changes."""

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
        keep_speed = 1  # SpeedGet returns 0 for it
        times_s = width_m / forward_m_s, width_m / backward_m_s
        self._ask("Scan.SpeedSet", forward_m_s, backward_m_s, *times_s, keep_speed, ratio)


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
    """The switch of the z controller, as its real-time part reports it, with a delay.

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


class MoveSpeed(Group):
    """The speed of the tip between scans, independent of the scan speed."""

    names = (names.MOVE_SPEED,)

    def read(self) -> dict[str, Value]:
        # Without a speed of its own, the tip moves at the scan speed between scans, too.
        speed_m_s, own = self._numbers("FolMe.SpeedGet")
        return {names.MOVE_SPEED: speed_m_s if own else self._numbers("Scan.SpeedGet")[0]}

    def write(self, values: Mapping[str, Value]) -> None:
        own = 1
        self._ask("FolMe.SpeedSet", float(values[names.MOVE_SPEED]), own)


class Slope(Group):
    """The compensation of the sample's tilt, as slopes; Nanonis has angles."""

    names = (names.SAMPLE_SLOPE_X, names.SAMPLE_SLOPE_Y)

    def read(self) -> dict[str, Value]:
        angles_deg = self._numbers("Piezo.TiltGet")
        return {name: math.tan(math.radians(deg)) for name, deg in zip(self.names, angles_deg, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        merged = self.merged(values)
        self._ask("Piezo.TiltSet", *(math.degrees(math.atan(float(merged[name]))) for name in self.names))


class DriftRate(Group):
    """The controller's own drift compensation, off if all velocities are 0. The z velocity is kept."""

    names = (DRIFT_RATE_X, DRIFT_RATE_Y)
    _usual_limit_percent: ClassVar[float] = 10.0

    def read(self) -> dict[str, Value]:
        on, *rates_m_s = self._numbers("Piezo.DriftCompGet")[:3]
        return {name: rate if on else 0.0 for name, rate in zip(self.names, rates_m_s, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        on, _, _, up_m_s, _, _, _, *limit = self._numbers("Piezo.DriftCompGet")
        x, y = (float(self.merged(values)[name]) for name in self.names)
        follows = bool(x or y or (on and up_m_s))
        # Release 2021 has no limit.
        limit_percent = limit[0] if limit else self._usual_limit_percent
        self._ask("Piezo.DriftCompSet", _ON if follows else _OFF, x, y, up_m_s, limit_percent)


class Probe(Group):
    """The position of the tip: the goal during a move, the position before during a scan.

    Args:
        now_s: returns experiment time.

    Attributes:
        arrives_s: expected arrival, experiment time.
    """

    names = POSITION
    _finest_part: ClassVar[float] = 2e-6
    """Resolution of the converters, as a share of the scanner's range."""

    def __init__(self, ask: Ask, now_s: Callable[[], float]) -> None:
        super().__init__(ask)
        self._now_s = now_s
        self.arrives_s = 0.0
        self._goal_m: tuple[float, float] | None = None
        self._seen_m: tuple[float, float] | None = None
        self._range_m: tuple[float, ...] = (math.inf, math.inf)

    def xy_m(self) -> tuple[float, float]:
        """Return the position of the tip, (x, y) in m."""
        if self._goal_m is not None:
            return self._goal_m
        if self._seen_m is not None and self._ask("Scan.StatusGet")[0]:
            return self._seen_m
        # A difference below the converters' resolution does not count as a move.
        x, y = self._numbers("FolMe.XYPosGet", 0)
        if self._seen_m is None or not self._near((x, y), self._seen_m):
            self._seen_m = (x, y)
        return self._seen_m

    def read(self) -> dict[str, Value]:
        return dict(zip(self.names, self.xy_m(), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        before_m = self.xy_m()
        x, y = (float(values.get(name, was)) for name, was in zip(self.names, before_m, strict=True))
        self._range_m = self._numbers("Piezo.RangeGet")[:2]
        # Nanonis would clip the position to the range without an error.
        for name, value, whole in zip(self.names, (x, y), self._range_m, strict=True):
            if abs(value) > whole / 2:
                raise refuse_value(
                    name,
                    f"{lengths_text([value])} is beyond the scanner's {lengths_text((-whole / 2, whole / 2), ' to ')}",
                )
        at_once = 0
        self._ask("FolMe.XYPosSet", x, y, at_once)
        self._goal_m = (x, y)
        speed_m_s = float(MoveSpeed(self._ask).read()[names.MOVE_SPEED])
        self.arrives_s = self._now_s() + (math.dist(before_m, (x, y)) / speed_m_s if speed_m_s > 0.0 else 0.0)

    def arrived(self) -> bool:
        """Return True if the tip has reached its goal, which then counts as its exact position."""
        if self._goal_m is None:
            return True
        if not self._near(self._numbers("FolMe.XYPosGet", 0), self._goal_m):
            return False
        self._seen_m, self._goal_m = self._goal_m, None
        return True

    def give_up(self) -> None:
        """Give up the goal: the measured position counts."""
        self._goal_m = self._seen_m = None

    def _near(self, a: tuple[Any, ...], b: tuple[float, float]) -> bool:
        return all(
            abs(one - other) <= max(1e-6 * abs(other), 0.0 if math.isinf(whole) else self._finest_part * whole)
            for one, other, whole in zip(a, b, self._range_m, strict=True)
        )


TRANSLATED: Final = (
    *(*ScanFrame.names, *ScanSpeed.names, *Gains.names, *MoveSpeed.names, *Slope.names, *DriftRate.names),
    *(*Probe.names, *FeedbackOn.names),
)
"""Names of all parameters that a group here translates."""


def same_float32(name: str, got: Value, other: Value, among: Mapping[str, Value]) -> bool:
    """Return True if two values are equal for a controller that stores most values as float32.

    Args:
        among: values read together with it: for a frame, all of its values.
    """
    if not (isinstance(got, float) and isinstance(other, float)):
        return got == other
    if name == names.SCAN_ANGLE:  # a controller may return 350 degrees as -10
        return abs(math.remainder(got - other, math.tau)) <= _DIGITS * math.tau
    # A corner is centre minus half the size: its rounding error is relative to the larger of them.
    largest = max(abs(float(among[part])) for part in _ADDED_UP & among.keys()) if name in _ADDED_UP else 0.0
    return math.isclose(got, other, rel_tol=_DIGITS, abs_tol=_DIGITS * largest)
