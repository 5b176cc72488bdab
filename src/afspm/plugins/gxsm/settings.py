"""Scan frame, tip position and feedback switch of GXSM.

GXSM defines a frame by its centre and a clockwise angle. `get` and `set` use the panel's unit of lengths, which the
user chooses; `moveto_scan_xy` and files are always in ångström. A range goes from the centre of the first pixel to the
centre of the last, as in afspm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from afspm.basics import AfspmError, Refused, convert, position_text
from afspm.driver import CENTER, FEEDBACK_ON, FRAME, POSITION, Kept, SettingsGroup, Value, frame, frame_values
from afspm.model import ControlResponse, Region, names
from afspm.plugins.gxsm.errors import BadReply, GxsmError
from afspm.plugins.gxsm.hardware import Doing
from afspm.plugins.gxsm.link import Asking

ANGSTROM_M: Final = 1e-10
_UNITS: Final = {"AA": "Å", "Ang": "Å", "\u00c5": "Å", "\u212b": "Å", "\u03bcm": "um", "\u00b5m": "um"}
_ROUNDED: Final = 0.06  # rounding of the panel's digits
REFNAMES: Final = ("PointsX", "PointsY", "RangeX", "RangeY", "OffsetX", "OffsetY", "Rotation")
SUBSCAN: Final = ("SPMC-sls-xs", "SPMC-sls-xn", "SPMC-sls-ys", "SPMC-sls-yn")
"""First column, columns, first row and rows of a *SubScan*; zeros without it. Gxsm3 has no such names."""
_READS: Final = 10
"""Most readings of a frame that is empty."""
_PLACE: Final = ("OffsetX", "OffsetY", "Rotation")
_SIZE: Final = {names.SCAN_SIZE_X, names.SCAN_SIZE_Y}
PIXELS: Final = {names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y}
_CORNER: Final = {names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y}


def user_unit_m(ask: Asking) -> float:
    """Return the unit of lengths on GXSM's panel, in m.

    Raises:
        BadReply: the unit is unknown, or panel and `get` disagree about RangeX.
        AfspmError: a decimal comma would make GXSM read 12.5 as 12.
    """
    shown, number = ask.text("gets", "RangeX").strip(), ask.number("get", "RangeX")
    digits, _, unit = shown.partition(" ")
    if "," in digits:
        hint = "start GXSM with LC_NUMERIC=C"
        raise AfspmError(f"GXSM shows {shown!r}, with a decimal comma: it would read 12.5 as 12", hint=hint)
    try:
        read, unit_m = float(digits), convert(1.0, _UNITS.get(unit.strip(), unit.strip()), "m")
    except (ValueError, AfspmError) as error:
        raise BadReply(f"GXSM shows {shown!r} for RangeX: {error}") from error
    if not math.isclose(read, number, rel_tol=0.01, abs_tol=_ROUNDED):
        raise BadReply(f"GXSM shows {shown!r} for RangeX on its panel, but returns {number}")
    return unit_m


class ScanFrame:
    """The frame of the next scan.

    Args:
        unit_m: unit of lengths; see `user_unit_m`.
    """

    def __init__(self, ask: Asking, unit_m: float) -> None:
        self._ask = ask
        self._unit_m = unit_m

    def read(self) -> dict[str, Value]:
        """Return the frame and its pixels by generic parameter names, in SI."""
        # while GXSM opens a file, it returns a range of 0 for a moment (seen in Gxsm4 4.4.1)
        for _ in range(_READS):
            columns, rows, width, height, x, y, clockwise_deg = (number(self._ask, ref) for ref in REFNAMES)
            if width and height:
                break
        center_m, size_m = (x * self._unit_m, y * self._unit_m), (width * self._unit_m, height * self._unit_m)
        angle_rad = 0.0 - math.radians(math.remainder(clockwise_deg, 720.0))
        return frame_values(Region(center_m, size_m, angle_rad), (round(rows), round(columns)))

    def write(self, values: Mapping[str, Value]) -> None:
        """Set the given parameters. X is set before Y, since setting X also changes Y in GXSM."""
        asked = values.keys()
        before = {} if asked >= set(FRAME) else self.read()
        region, (rows, columns) = frame({**before, **values})
        if asked & PIXELS:
            self._send("PointsX", columns)
            self._send("PointsY", rows)
        if asked & (PIXELS | _SIZE):
            self._send("RangeX", region.size_m[0] / self._unit_m)
            self._send("RangeY", region.size_m[1] / self._unit_m)
        if asked & (_SIZE | _CORNER):
            self._send("OffsetX", region.center_m[0] / self._unit_m)
            self._send("OffsetY", region.center_m[1] / self._unit_m)
        if names.SCAN_ANGLE in asked:
            self._send("Rotation", 0.0 - math.degrees(region.angle_rad))

    def region(self) -> Region:
        return frame(self.read())[0]

    def place(self) -> list[float]:
        """Return centre and angle as GXSM shows them: a change moves the tip at once, even during a scan."""
        return [number(self._ask, ref) for ref in _PLACE]

    def move_tip(self, xy_m: tuple[float, float]) -> None:
        """Move the tip to (x, y) in m. Raises Refused with PARAM_ERROR: the position is outside the frame."""
        region = self.region()
        u_m, v_m = in_frame(region, xy_m)
        if self._ask.number("moveto_scan_xy", u_m / ANGSTROM_M, v_m / ANGSTROM_M) != 0.0:
            place = position_text(xy_m)
            reason = f"GXSM moves the tip only within the scan frame; {place} is outside: set a scan region around it"
            raise Refused(ControlResponse.PARAM_ERROR, reason)

    def tip(self) -> tuple[float, float]:
        """Return GXSM's target of the tip, (x, y) in m; the frame's centre if GXSM returns no target."""
        region = self.region()
        try:
            u_m, v_m = (number(self._ask, ref) * self._unit_m for ref in ("ScanX", "ScanY"))
        except (GxsmError, BadReply):
            return region.center_m
        return in_space(region, (u_m, v_m))

    def _send(self, ref: str, value: float) -> None:
        send(self._ask, ref, value)


def subscan(ask: Asking, shape: tuple[int, int]) -> str:
    """Return a description of the part of the frame that *SubScan* scans; empty: the whole frame is scanned.

    Args:
        shape: (rows, columns) of the frame.
    """
    left, width, top, height = (round(number(ask, ref)) for ref in SUBSCAN)
    rows, columns = shape
    if not (width or height) or (left, width, top, height) == (0, columns, 0, rows):
        return ""
    return f"{width} of {columns} columns from {left}, {height} of {rows} rows from {top}"


class FrameSettings(SettingsGroup):
    """The frame of the next scan, as a group of settings.

    Args:
        tip: receives the length of each move of the tip with the frame.
        is_led: True if the tip follows a change of the frame, and GXSM does not report this move.
    """

    names = (*FRAME, *CENTER)

    def __init__(self, scan_frame: ScanFrame, tip: TipPlace, *, is_led: bool) -> None:
        self._frame = scan_frame
        self._tip = tip
        self._is_led = is_led

    def read(self) -> dict[str, Value]:
        found = self._frame.read()
        return found | dict(zip(CENTER, frame(found)[0].center_m, strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        moves = self._is_led and not values.keys() <= PIXELS
        before_m = self._frame.tip() if moves else None
        self._frame.write(values)
        if before_m is not None:
            self._tip.on_move(math.dist(before_m, self._frame.tip()))


class TipPlace(SettingsGroup):
    """The target position of the tip, stored because GXSM's files of spectra lack the position.

    Args:
        kept: persistent, JSON-able: the last set position.
        on_move: called with the length of a move in m, at its start.
    """

    names = POSITION

    def __init__(self, scan_frame: ScanFrame, kept: Kept, on_move: Callable[[float], None]) -> None:
        self.frame = scan_frame
        self._kept = kept
        self.on_move = on_move

    def xy_m(self) -> tuple[float, float]:
        """Return the last set position, (x, y) in m; before the first, GXSM's target of the tip."""
        sent = self._kept.get("probe")
        return self.frame.tip() if sent is None else (float(sent[0]), float(sent[1]))

    def read(self) -> dict[str, Value]:
        return dict(zip(POSITION, self.xy_m(), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        x, y = (float(values.get(name, was)) for name, was in zip(POSITION, self.xy_m(), strict=True))
        way_m = math.dist(self.frame.tip(), (x, y))
        self.frame.move_tip((x, y))
        self._kept["probe"] = [x, y]
        self.on_move(way_m)


class FeedbackSwitch(SettingsGroup):
    """The feedback switch, as a group of settings; only some hardware has actions that operate the switch.

    Args:
        doing: returns the state that GXSM reports.
        actions: names of the actions for on and off; empty: the switch can only be read.
    """

    names = (FEEDBACK_ON,)

    def __init__(self, ask: Asking, doing: Callable[[], Doing], actions: Sequence[str]) -> None:
        self._ask = ask
        self._doing = doing
        self._actions = actions

    def read(self) -> dict[str, Value]:
        return {FEEDBACK_ON: self._doing().feedback_on}

    def write(self, values: Mapping[str, Value]) -> None:
        on, off = self._actions
        self._ask.call("action", on if values[FEEDBACK_ON] else off)


def number(ask: Asking, ref: str) -> float:
    """Return the value of a parameter in GXSM's unit. Raises BadReply: GXSM returned no finite number."""
    value = ask.number("get", ref)
    if not math.isfinite(value):
        raise BadReply(f"GXSM returned {value} for {ref}")
    return value


def send(ask: Asking, ref: str, value: float) -> None:
    """Set a parameter, in GXSM's unit. GXSM never reports a failure: the value must be read back.

    GXSM takes a text, and parses its longest numeric prefix with a decimal point.
    """
    ask.call("set", ref, repr(value))


def in_frame(region: Region, xy_m: tuple[float, float]) -> tuple[float, float]:
    """Convert (x, y) to coordinates of a scan region: offsets from its centre along its sides; all in m."""
    x, y = xy_m[0] - region.center_m[0], xy_m[1] - region.center_m[1]
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    return cos * x + sin * y, cos * y - sin * x


def in_space(region: Region, uv_m: tuple[float, float]) -> tuple[float, float]:
    """Convert coordinates in the frame to (x, y) in m; the inverse of `in_frame`."""
    cos, sin = math.cos(region.angle_rad), math.sin(region.angle_rad)
    (u, v), (x, y) = uv_m, region.center_m
    return x + cos * u - sin * v, y + sin * u + cos * v
