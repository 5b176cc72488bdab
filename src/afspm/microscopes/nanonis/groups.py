"""Generic parameters that Nanonis has in other groupings, units or directions than a table could say.

A group is read by one question and written by one command, by generic names, in SI. What a `…Get` replies is never put
into a `…Set` as it is where the two count differently (the table of `protocol`, "Traps" in the README).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final

from afspm.microscopes.nanonis.protocol import BadReply
from afspm.model import names
from afspm.translator.parameters import FEEDBACK_ON, Value, refuse_value
from afspm.translator.settings import FRAME, POSITION, frame

Ask = Callable[..., tuple[Any, ...]]

DRIFT_RATE_X: Final = "x-drift-rate-x"
DRIFT_RATE_Y: Final = "x-drift-rate-y"

_PIXELS_AT_ONCE: Final = 16
_ON, _OFF = 1, 2
"""In what is set; in what is got they are 1 and 0."""


class Group(ABC):
    """Parameters that belong together at the controller."""

    names: tuple[str, ...]

    @abstractmethod
    def read(self, ask: Ask) -> dict[str, Value]:
        """What is in force."""

    @abstractmethod
    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        """Change some of them.

        Raises:
            Refused: PARAM_ERROR: the controller would make something else of it.
        """

    def _merged(self, ask: Ask, values: Mapping[str, Value]) -> dict[str, Any]:
        return {**self.read(ask), **values}


def numbers(ask: Ask, name: str, *arguments: Any) -> tuple[Any, ...]:
    """The numbers that a function replies.

    Raises:
        BadReply: one is not finite: nothing can be set by it.
    """
    found = ask(name, *arguments)
    for value in found:
        if isinstance(value, float) and not math.isfinite(value):
            raise BadReply(f"Nanonis says {value} in reply to {name}")
    return found


class ScanFrame(Group):
    """Nanonis has the centre, a clockwise angle in degrees, and the range of whole pixels: N pixels of range / N."""

    names = FRAME

    def read(self, ask: Ask) -> dict[str, Value]:
        _, columns, rows = ask("Scan.BufferGet")
        x, y, width, height, clockwise_deg = numbers(ask, "Scan.FrameGet")
        if min(columns, rows) < 1 or min(width, height) <= 0.0:
            raise BadReply(f"Nanonis says that the frame is {width} m x {height} m of {columns} x {rows} pixels")
        size_x, size_y = width * _share(columns), height * _share(rows)
        return {
            names.SCAN_TOP_LEFT_X: x - size_x / 2,
            names.SCAN_TOP_LEFT_Y: y - size_y / 2,
            names.SCAN_SIZE_X: size_x,
            names.SCAN_SIZE_Y: size_y,
            names.SCAN_ANGLE: 0.0 - math.radians(clockwise_deg),
            names.SCAN_RESOLUTION_X: columns,
            names.SCAN_RESOLUTION_Y: rows,
        }

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        region, (rows, columns) = frame(self._merged(ask, values))
        if columns % _PIXELS_AT_ONCE:
            below = max(columns // _PIXELS_AT_ONCE, 1) * _PIXELS_AT_ONCE
            raise refuse_value(
                names.SCAN_RESOLUTION_X,
                f"Nanonis scans multiples of {_PIXELS_AT_ONCE} pixels a line: "
                f"{below} or {below + _PIXELS_AT_ONCE}, not {columns}",
            )
        if names.SCAN_RESOLUTION_X in values or names.SCAN_RESOLUTION_Y in values:
            ask("Scan.BufferSet", ask("Scan.BufferGet")[0], columns, rows)
        width, height = region.size_m
        ask(
            "Scan.FrameSet",
            *region.center_m,
            width / _share(columns),
            height / _share(rows),
            0.0 - math.degrees(region.angle_rad),
        )


def _share(pixels: int) -> float:
    """Of the range, what lies between the first and the last pixel."""
    return (pixels - 1) / pixels if pixels > 1 else 1.0


class ScanSpeed(Group):
    """The speed forward; that backward keeps its ratio, and the speeds are what is kept when the frame changes."""

    names = (names.SCAN_SPEED,)

    def read(self, ask: Ask) -> dict[str, Value]:
        return {names.SCAN_SPEED: numbers(ask, "Scan.SpeedGet")[0]}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        forward_m_s = float(values[names.SCAN_SPEED])
        *_, ratio = numbers(ask, "Scan.SpeedGet")
        width_m = numbers(ask, "Scan.FrameGet")[2]
        backward_m_s = forward_m_s * ratio
        if min(forward_m_s, backward_m_s) <= 0.0:
            raise refuse_value(names.SCAN_SPEED, f"{forward_m_s} m/s, and {ratio} times that back, is no speed")
        keep_speed = 1  # 0 in what SpeedGet replies
        times_s = width_m / forward_m_s, width_m / backward_m_s
        ask("Scan.SpeedSet", forward_m_s, backward_m_s, *times_s, keep_speed, ratio)


class Gains(Group):
    """Nanonis has P, the time constant T and I = P / T."""

    names = (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)

    def read(self, ask: Ask) -> dict[str, Value]:
        proportional, _, integral = ask("ZCtrl.GainGet")  # T is infinite where there is no I
        return {names.ZCTRL_PGAIN: proportional, names.ZCTRL_IGAIN: integral}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        merged = self._merged(ask, values)
        proportional, integral = float(merged[names.ZCTRL_PGAIN]), float(merged[names.ZCTRL_IGAIN])
        if proportional <= 0.0 or integral <= 0.0:
            reason = "Nanonis has I = P / T: with P or I at 0 there is no time constant T"
            raise refuse_value(f"{names.ZCTRL_PGAIN}, {names.ZCTRL_IGAIN}", reason)
        ask("ZCtrl.GainSet", proportional, proportional / integral, integral)


class FeedbackOn(Group):
    """The z controller, on or off, as its real-time part says; it follows with a delay."""

    names = (FEEDBACK_ON,)

    def __init__(self, monotonic_s: Callable[[], float], at_most_s: float) -> None:
        self._monotonic_s = monotonic_s
        self._at_most_s = at_most_s

    def read(self, ask: Ask) -> dict[str, Value]:
        return {FEEDBACK_ON: ask("ZCtrl.OnOffGet")[0] == 1}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        wanted = bool(values[FEEDBACK_ON])
        ask("ZCtrl.OnOffSet", int(wanted))
        until_s = self._monotonic_s() + self._at_most_s
        while self.read(ask)[FEEDBACK_ON] is not wanted and self._monotonic_s() < until_s:
            pass  # each question takes as long as the controller takes to answer it


class MoveSpeed(Group):
    """Of the tip outside of scans: a speed of its own, not that of scans."""

    names = (names.MOVE_SPEED,)

    def read(self, ask: Ask) -> dict[str, Value]:
        speed_m_s, own = numbers(ask, "FolMe.SpeedGet")
        return {names.MOVE_SPEED: speed_m_s if own else numbers(ask, "Scan.SpeedGet")[0]}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        own = 1
        ask("FolMe.SpeedSet", float(values[names.MOVE_SPEED]), own)


class Slope(Group):
    """The compensation of the sample's tilt, which Nanonis has as angles."""

    names = (names.SAMPLE_SLOPE_X, names.SAMPLE_SLOPE_Y)

    def read(self, ask: Ask) -> dict[str, Value]:
        angles_deg = numbers(ask, "Piezo.TiltGet")
        return {name: math.tan(math.radians(deg)) for name, deg in zip(self.names, angles_deg, strict=True)}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        merged = self._merged(ask, values)
        ask("Piezo.TiltSet", *(math.degrees(math.atan(float(merged[name]))) for name in self.names))


class DriftRate(Group):
    """The speed at which the controller follows the sample by itself; off when both are 0. That in z stays."""

    names = (DRIFT_RATE_X, DRIFT_RATE_Y)
    _usual_limit_percent: ClassVar[float] = 10.0

    def read(self, ask: Ask) -> dict[str, Value]:
        on, *rates_m_s = numbers(ask, "Piezo.DriftCompGet")[:3]
        return {name: rate if on else 0.0 for name, rate in zip(self.names, rates_m_s, strict=True)}

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        on, _, _, up_m_s, _, _, _, *limit = numbers(ask, "Piezo.DriftCompGet")
        x, y = (float(self._merged(ask, values)[name]) for name in self.names)
        follows = bool(x or y or (on and up_m_s))
        limit_percent = limit[0] if limit else self._usual_limit_percent
        ask("Piezo.DriftCompSet", _ON if follows else _OFF, x, y, up_m_s, limit_percent)


class Probe(Group):
    """Where the tip is: where it was sent while it is on its way, where it was before while a scan leads it.

    Attributes:
        goal_m: where it is going; None when it is not.
        arrives_s: when it should be there, experiment time.
    """

    names = POSITION
    _finest_part: ClassVar[float] = 2e-6
    """Of the scanner's range: what its converters can tell apart."""

    def __init__(self) -> None:
        self.goal_m: tuple[float, float] | None = None
        self.arrives_s = 0.0
        self._seen_m: tuple[float, float] | None = None
        self._range_m = (math.inf, math.inf)

    def read(self, ask: Ask) -> dict[str, Value]:
        xy_m = self.goal_m
        if xy_m is None and self._seen_m is not None and ask("Scan.StatusGet")[0]:
            xy_m = self._seen_m
        if xy_m is None:
            xy_m = self._look(ask)
        return dict(zip(self.names, xy_m, strict=True))

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        merged = self._merged(ask, values)
        x, y = (float(merged[name]) for name in self.names)
        self._range_m = numbers(ask, "Piezo.RangeGet")[:2]
        for name, value, whole in zip(self.names, (x, y), self._range_m, strict=True):
            if abs(value) > whole / 2:
                raise refuse_value(name, f"{value:g} m is beyond the scanner's {-whole / 2:g} to {whole / 2:g} m")
        at_once = 0
        ask("FolMe.XYPosSet", x, y, at_once)
        self.goal_m = (x, y)

    def arrived(self, ask: Ask) -> bool:
        """Whether it is where it was sent; it then counts as being there exactly."""
        if self.goal_m is None:
            return True
        if not self._near(numbers(ask, "FolMe.XYPosGet", 0), self.goal_m):
            return False
        self._seen_m, self.goal_m = self.goal_m, None
        return True

    def give_up(self) -> None:
        """It does not get there: where it is counts."""
        self.goal_m = self._seen_m = None

    def _look(self, ask: Ask) -> tuple[float, float]:
        x, y = numbers(ask, "FolMe.XYPosGet", 0)
        if self._seen_m is None or not self._near((x, y), self._seen_m):
            self._seen_m = (x, y)
        return self._seen_m

    def _near(self, a: tuple[Any, ...], b: tuple[float, float]) -> bool:
        return all(
            abs(one - other) <= max(1e-6 * abs(other), 0.0 if math.isinf(whole) else self._finest_part * whole)
            for one, other, whole in zip(a, b, self._range_m, strict=True)
        )


class Kept(Group):
    """What Nanonis is told with an action, and does not keep itself.

    Args:
        kept: the memory that they are in.
        at_first: their values before anybody sets them, and their names.
    """

    def __init__(self, kept: dict[str, Any], at_first: Mapping[str, Value]) -> None:
        self._kept = kept
        self.names = tuple(at_first)
        for name, value in at_first.items():
            self._kept.setdefault(name, value)

    def read(self, ask: Ask) -> dict[str, Value]:
        return dict(self._kept)

    def write(self, ask: Ask, values: Mapping[str, Value]) -> None:
        self._kept.update(values)


OTHERS: Final = (ScanFrame(), ScanSpeed(), Gains(), MoveSpeed(), Slope(), DriftRate())
"""Those that remember nothing."""
NAMES: Final = tuple(name for group in (*OTHERS, Probe, FeedbackOn) for name in group.names)
"""Of all parameters that any group translates but `Kept`."""
