"""Frame, speed and tip position: conversion between Studio's values and generic parameters.

Studio has the centre of a frame, its angle, and lines per second; a line is forward and backward
(! line-both-ways, frame-centre, angle-counter-clockwise, target-offset).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from afspm.basics import InvalidValue
from afspm.driver import FRAME, POSITION, SettingsGroup, Value, check_speed, frame, frame_values
from afspm.model import Region, names
from afspm.plugins.nanosurf import commands
from afspm.plugins.nanosurf.session import Session

DIRECTION: Final = "imaging.slow_axis_scan_direction"
_UPWARD, _DOWNWARD = 1, 0
_WIDTH, _HEIGHT = "imaging.scan_range_fast_axis", "imaging.scan_range_slow_axis"
_X, _Y = "imaging.frame_center_offset_x", "imaging.frame_center_offset_y"
_ANGLE, _RATE = "imaging.rotation", "imaging.line_rate"
_COLUMNS, _ROWS = "imaging.points_per_line", "imaging.lines_per_frame"
_FRAME: Final = (_X, _Y, _WIDTH, _HEIGHT, _ANGLE, _COLUMNS, _ROWS, _RATE)
_SLOPES: Final = ("imaging.slope_x", "imaging.slope_y")
_TARGET: Final = ("scanner.offset_x_target", "scanner.offset_y_target")
_PLACE: Final = ("scanner.offset_x", "scanner.offset_y")
_SPEED: Final = "scanner.move_speed_xy_on_surface"
_LATEST_S: Final = 10.0
"""Experiment time beyond twice the expected duration of a move, until the move counts as failed."""
UNITS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys((_X, _Y, _WIDTH, _HEIGHT, *_TARGET, *_PLACE), ("m",)),
    **dict.fromkeys((_ANGLE, *_SLOPES), ("°", "deg")),
    _RATE: ("Hz", "1/s"),
    _SPEED: ("m/s",),
}
"""Accepted units of Studio's values: the conversions here are right for these units only."""
SPEED_PATH: Final = 2.0
"""Path of the tip in a line, in widths of the frame: forward and backward (! line-both-ways)."""


class FrameSettings(SettingsGroup):
    """Frame and speed, set together since the speed depends on the width and the line rate."""

    names = frozenset({*FRAME, names.SCAN_SPEED})

    def __init__(self, session: Callable[[], Session]) -> None:
        self._session = session

    def read(self) -> dict[str, Value]:
        found = {path: float(value) for path, value in self._session().values(_FRAME).items()}
        angle_rad = math.radians(found[_ANGLE])
        region = Region((found[_X], found[_Y]), (found[_WIDTH], found[_HEIGHT]), angle_rad)
        shape = (round(found[_ROWS]), round(found[_COLUMNS]))
        speed_m_s = SPEED_PATH * found[_WIDTH] * found[_RATE]
        return {**frame_values(region, shape), names.SCAN_SPEED: speed_m_s}

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        region, (rows, columns) = frame(wanted)
        speed_m_s = float(wanted[names.SCAN_SPEED])
        if speed_m_s <= 0.0:
            raise InvalidValue(f"the scan speed must be above 0, not {speed_m_s:g} m/s")
        (x, y), (width, height) = region.center_m, region.size_m
        rate = speed_m_s / (SPEED_PATH * width)
        angle_deg = math.degrees(region.angle_rad)
        self._session().put(dict(zip(_FRAME, (x, y, width, height, angle_deg, columns, rows, rate), strict=True)))
        check_speed(speed_m_s, float(self.read()[names.SCAN_SPEED]))


class Slopes(SettingsGroup):
    """The compensation of the sample's tilt, as slopes; Studio has angles (! slope-sign)."""

    names = (names.SAMPLE_SLOPE_X, names.SAMPLE_SLOPE_Y)

    def __init__(self, session: Callable[[], Session]) -> None:
        self._session = session

    def read(self) -> dict[str, Value]:
        angles = self._session().values(_SLOPES).values()
        return {name: math.tan(math.radians(float(angle))) for name, angle in zip(self.names, angles, strict=True)}

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        angles = (math.degrees(math.atan(float(wanted[name]))) for name in self.names)
        self._session().put(dict(zip(_SLOPES, angles, strict=True)))


class TipPlace(SettingsGroup):
    """The target position of the tip.

    Args:
        now_s: returns experiment time.
        on_late: called when a move is given up, because the tip has not reached the target in time.
    """

    names = POSITION

    def __init__(self, session: Callable[[], Session], now_s: Callable[[], float], on_late: Callable[[], None]) -> None:
        self._session, self._now_s, self._on_late = session, now_s, on_late
        self._moving = False
        self._latest_s = 0.0

    def read(self) -> dict[str, Value]:
        return dict(zip(POSITION, self.xy_m(), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = self.merged(values)
        self._session().put(dict(zip(_TARGET, (float(wanted[name]) for name in POSITION), strict=True)))
        self.go()

    def xy_m(self) -> tuple[float, float]:
        """Return the target position of the tip, (x, y) in m."""
        x, y = (float(value) for value in self._session().values(_TARGET).values())
        return x, y

    def go(self) -> None:
        """Start moving the tip to the target. Raises Refused: ACTION_ERROR."""
        x, y, to_x, to_y, speed_m_s = (
            float(one) for one in self._session().values((*_PLACE, *_TARGET, _SPEED)).values()
        )
        self._session().do(commands.MOVE)
        lasts_s = math.dist((x, y), (to_x, to_y)) / speed_m_s if speed_m_s > 0.0 else 0.0
        self._latest_s = self._now_s() + 2.0 * lasts_s + _LATEST_S
        self._moving = True

    def arrived(self) -> bool:
        """Return whether the last move by `go` has ended; True without a move.

        A move has ended once the tip is within 1 nm of the target, or within 0.1 % of the target's distance from the
        origin. A move that takes much longer than expected is given up.
        """
        if self._moving:
            x, y, to_x, to_y = (float(value) for value in self._session().values((*_PLACE, *_TARGET)).values())
            self._moving = math.dist((x, y), (to_x, to_y)) > max(1e-9, 1e-3 * math.hypot(to_x, to_y))
            if self._moving and self._now_s() >= self._latest_s:
                self._moving = False
                self._on_late()
        return not self._moving


def direction(name: str) -> int:
    """Return Studio's number for "up" or "down"."""
    return _UPWARD if name == names.UP else _DOWNWARD
