"""Frame, speed and tip position: conversion between Asylum's values and generic parameters; lengths in m.

Asylum's XOffset and YOffset are the centre of the frame, as files of zoomed images show. ScanSize is the longer side;
two ratios define the shorter side; FastScanSize and SlowScanSize are the result. Asylum's angles are in degrees,
clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from afspm.basics import InvalidValue, Refused
from afspm.driver import FEEDBACK_ON, FRAME, POSITION, SettingsGroup, Value, frame, frame_values
from afspm.model import ControlResponse, Region, names
from afspm.plugins.asylum.scan_files import clockwise, counter_clockwise
from afspm.plugins.asylum.session import Session

GLOBALS: Final = (
    "XOffset", "YOffset", "FastScanSize", "SlowScanSize", "ScanAngle", "ScanPoints", "ScanLines", "ScanRate",
)  # fmt: skip
NAMES: Final = frozenset({*FRAME, names.SCAN_SPEED})

_OUR_SPOT: Final = 1.0
PATH_OF_A_LINE: Final = 2.5
"""Path of the tip in a line, in widths of the frame.

The notes of all real files have this value of ScanSpeed / (FastScanSize · ScanRate)."""


def generic(found: Mapping[str, float]) -> dict[str, Value]:
    """Convert Asylum's `GLOBALS` to generic parameters in SI."""
    size_m = (found["FastScanSize"], found["SlowScanSize"])
    region = Region((found["XOffset"], found["YOffset"]), size_m, counter_clockwise(found["ScanAngle"]))
    shape = (round(found["ScanLines"]), round(found["ScanPoints"]))
    speed_m_s = PATH_OF_A_LINE * found["FastScanSize"] * found["ScanRate"]
    return {**frame_values(region, shape), names.SCAN_SPEED: speed_m_s}


def asylums(wanted: Mapping[str, Value], before: Mapping[str, Value]) -> dict[str, float]:
    """Convert generic parameters to Asylum's values, given all of `NAMES` as set before.

    All dependent values are included, since PV updates none of them, unlike the panel. Asylum scans by its ScanRate,
    which is set so that the speed is kept when the width changes.

    Raises:
        InvalidValue: the parameters describe no frame, or the speed is not above 0.
    """
    values = {**before, **wanted}
    region, (rows, columns) = frame(values)
    speed_m_s = float(values[names.SCAN_SPEED])
    fast_m, slow_m = region.size_m
    if speed_m_s <= 0.0:
        raise InvalidValue(f"the scan speed must be above 0, not {speed_m_s:g} m/s")
    shorter_m = min(fast_m, slow_m)
    return {
        "XOffset": region.center_m[0],
        "YOffset": region.center_m[1],
        "ScanSize": max(fast_m, slow_m),
        "FastRatio": fast_m / shorter_m,
        "SlowRatio": slow_m / shorter_m,
        "FastScanSize": fast_m,
        "SlowScanSize": slow_m,
        "ScanAngle": clockwise(region.angle_rad),
        "ScanPoints": float(columns),
        "ScanLines": float(rows),
        "ScanRate": speed_m_s / (PATH_OF_A_LINE * fast_m),
        "ScanSpeed": speed_m_s,
    }


def on_image(xy_m: tuple[float, float], image: Region) -> tuple[float, float]:
    """Convert a position to an Asylum spot: from the lower left corner of the image, along its axes."""
    cos, sin = math.cos(image.angle_rad), math.sin(image.angle_rad)
    dx, dy = xy_m[0] - image.center_m[0], xy_m[1] - image.center_m[1]
    return cos * dx + sin * dy + image.size_m[0] / 2, cos * dy - sin * dx + image.size_m[1] / 2


def from_image(spot_m: tuple[float, float], image: Region) -> tuple[float, float]:
    """Convert an Asylum spot to a position: the inverse of `on_image`."""
    cos, sin = math.cos(image.angle_rad), math.sin(image.angle_rad)
    dx, dy = spot_m[0] - image.size_m[0] / 2, spot_m[1] - image.size_m[1] / 2
    return image.center_m[0] + cos * dx - sin * dy, image.center_m[1] + cos * dy + sin * dx


class FrameSettings(SettingsGroup):
    """The frame and the speed of scans. A write sends only values that differ from Asylum's.

    Args:
        igor: returns the session.
        in_force: returns all of `NAMES` as set before.
        on_read: receives each frame that was read.
    """

    names = NAMES

    def __init__(
        self,
        igor: Callable[[], Session],
        in_force: Callable[[], Mapping[str, Value]],
        on_read: Callable[[Region], None],
    ) -> None:
        self._igor = igor
        self._in_force = in_force
        self._on_read = on_read

    def read(self) -> dict[str, Value]:
        found = generic(self._igor().values(GLOBALS))
        self._on_read(frame(found)[0])
        return found

    def write(self, values: Mapping[str, Value]) -> None:
        wanted = asylums(values, self._in_force())
        there = self._igor().values(list(wanted))
        # each PV is a request of its own, and takes Igor some ten milliseconds
        self._igor().put({name: value for name, value in wanted.items() if there[name] != value})


class TipPlace(SettingsGroup):
    """The spot to which the tip is sent.

    Args:
        image: returns the frame of the last image, the origin of spots; None: the origin is the middle of the scanner.
        on_move: called when the tip starts moving.
    """

    names = POSITION

    def __init__(
        self, igor: Callable[[], Session], image: Callable[[], Region] | None, on_move: Callable[[], None]
    ) -> None:
        self._igor = igor
        self._image = image
        self._on_move = on_move

    def xy_m(self) -> tuple[float, float]:
        """Return the target position of the tip, (x, y) in m."""
        spot_m = (self._igor().number("GetProbePosX"), self._igor().number("GetProbePosY"))
        return spot_m if self._image is None else from_image(spot_m, self._image())

    def read(self) -> dict[str, Value]:
        return dict(zip(POSITION, self.xy_m(), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        x, y = (float(values.get(name, was)) for name, was in zip(POSITION, self.xy_m(), strict=True))
        self.put((x, y))
        self.go()

    def put(self, xy_m: tuple[float, float]) -> None:
        """Set the spot, for a position (x, y) in m, without moving the tip. Raises Refused: PARAM_ERROR."""
        x, y = xy_m if self._image is None else on_image(xy_m, self._image())
        if not (self._igor().do("SetProbePosX", x) and self._igor().do("SetProbePosY", y)):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum refused the spot")

    def go(self) -> None:
        """Start moving the tip to the spot. Raises Refused: PARAM_ERROR."""
        self._igor().put({"ForceSpotNumber": _OUR_SPOT})  # a person may have chosen another spot at the panel
        if not self._igor().do("DoForceFunc", "Go"):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum refused to move the tip")
        self._on_move()


class FeedbackSwitch(SettingsGroup):
    """The z feedback switch. A write waits for the new state of the feedback, as the tip may have to travel.

    Args:
        wait_for: waits for a condition, up to a time limit; afterwards the read-back of the write decides.
    """

    names = (FEEDBACK_ON,)

    def __init__(self, igor: Callable[[], Session], wait_for: Callable[[Callable[[], bool]], bool]) -> None:
        self._igor = igor
        self._wait_for = wait_for

    def read(self) -> dict[str, Value]:
        return {FEEDBACK_ON: self._igor().feedback_on()}

    def write(self, values: Mapping[str, Value]) -> None:
        igor, on = self._igor(), bool(values[FEEDBACK_ON])
        if igor.feedback_on() is on:
            return
        if not igor.do("AfspmFeedback", int(on)):
            raise Refused(ControlResponse.PARAM_ERROR, "Asylum could not switch the feedback")
        self._wait_for(lambda: igor.feedback_on() is on)
