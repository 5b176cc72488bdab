"""Conversion of the scan frame and the tip's position between Nanonis' geometry and afspm's.

Nanonis defines a frame by its centre, a clockwise angle in degrees, and a range from edge to edge of the outer pixels;
afspm by corner or centre, a counter-clockwise angle in rad, and a size from centre to centre of the outer pixels.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Final

from afspm.basics import lengths_text
from afspm.driver import FRAME, POSITION, ParameterSpec, Value, check_speed, frame, frame_values, refuse_value
from afspm.model import Region, names
from afspm.plugins.nanonis.parameter_groups import Ask, Group, MoveSpeed, keep_speed, set_speed
from afspm.plugins.nanonis.protocol import BadReply, NanonisError

_OUTPUT_V: Final = 10.0
"""Amount of the largest voltage of Nanonis' outputs, to which the piezo calibration belongs."""
_SHOWS_SCAN_S: Final = 1.5
"""Experiment time until a scan is shown as running, with a margin: others report a second. (! late-start)"""
_DIGITS: Final = 1e-6  # relative precision of float32, with a margin
_ADDED_UP: Final = frozenset(FRAME) - {names.SCAN_ANGLE, names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y}
"""Parameters calculated from centre and size: the rounding error of the largest value applies to each."""


class ScanFrame(Group):
    """The scan frame, with its number of pixels."""

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
        if names.SCAN_RESOLUTION_X in values or names.SCAN_RESOLUTION_Y in values:
            self._ask("Scan.BufferSet", self._ask("Scan.BufferGet")[0], columns, rows)
        # a frame set wider with the time per line kept would be scanned faster, beyond any limit of the speed
        speeds_m_s = keep_speed(self._ask)
        width, height = region.size_m
        self._ask(
            "Scan.FrameSet",
            *region.center_m,
            width / _share(columns),
            height / _share(rows),
            0.0 - math.degrees(region.angle_rad),
        )
        made_m_s = self._numbers("Scan.SpeedGet")[0]
        if not math.isclose(speeds_m_s[0], made_m_s, rel_tol=_DIGITS):
            # (! keep-speed) others keep the time a line although asked to keep the speed
            set_speed(self._ask, *speeds_m_s, width / _share(columns))
            made_m_s = self._numbers("Scan.SpeedGet")[0]
        check_speed(speeds_m_s[0], made_m_s)


def _share(pixels: int) -> float:
    # Nanonis' range goes from edge to edge of the pixels, afspm's from centre to centre.
    return (pixels - 1) / pixels if pixels > 1 else 1.0


class Probe(Group):
    """The position of the tip: during a move the target, during a scan the position before the scan.

    A position that neither a request nor a scan has left counts after `_SHOWS_SCAN_S`: a scan may not be shown yet.

    Args:
        now_s: returns experiment time.
        awaits_scan: returns whether a scan was started that Nanonis does not show as running yet.

    Attributes:
        arrives_s: expected arrival, experiment time.
    """

    names = POSITION
    _finest_part: ClassVar[float] = 2e-6
    """Resolution of the converters, as a share of the scanner's range."""

    def __init__(self, ask: Ask, now_s: Callable[[], float], awaits_scan: Callable[[], bool]) -> None:
        super().__init__(ask)
        self._now_s, self._awaits_scan = now_s, awaits_scan
        self.arrives_s = 0.0
        self._goal_m: tuple[float, float] | None = None
        self._seen_m: tuple[float, float] | None = None
        self._left_s: float | None = None
        self._scanned = False
        self._range_m: tuple[float, ...] = (math.inf, math.inf)
        self._unknown_range = "it was not asked"

    def xy_m(self, *, between_scans: bool = False) -> tuple[float, float]:
        """Return the position of the tip, (x, y) in m; for moves and scans, see the class.

        Args:
            between_scans: whether no scan is known to run; otherwise Nanonis is asked.
        """
        if self._goal_m is not None:
            return self._goal_m
        if self._seen_m is not None and not between_scans and (self._ask("Scan.StatusGet")[0] or self._awaits_scan()):
            self._left_s, self._scanned = None, True
            return self._seen_m
        # A difference below the converters' resolution does not count as a move.
        x, y = self._numbers("FolMe.XYPosGet", 0)
        if self._seen_m is not None and self._near((x, y), self._seen_m):
            self._left_s = None
        elif self._seen_m is None or between_scans or self._scanned or self._is_no_scan():
            self._seen_m, self._left_s, self._scanned = (x, y), None, False
        return self._seen_m

    def forget(self) -> None:
        """Forget the position that was seen: a scan may have moved the tip while Nanonis was away."""
        self._seen_m = self._left_s = None

    def _is_no_scan(self) -> bool:
        # a scan that a person begins moves the tip before Nanonis shows it as running
        now_s = self._now_s()
        if self._left_s is None:
            self._left_s = now_s
        return now_s - self._left_s >= _SHOWS_SCAN_S

    def read(self) -> dict[str, Value]:
        return dict(zip(self.names, self.xy_m(), strict=True))

    def write(self, values: Mapping[str, Value]) -> None:
        # the values are read right before they are set, by the translator
        before_m = self._goal_m or self.xy_m(between_scans=True)
        x, y = (float(values.get(name, was)) for name, was in zip(self.names, before_m, strict=True))
        # Nanonis would clip a position beyond its range without an error.
        if why := self._unknown_range:
            what = f"Nanonis does not report the scanner's range ({why}), so that no position can be checked"
            raise refuse_value(self.names[0], f"{what}; move the tip at the panel")
        speed_m_s, at_once = float(MoveSpeed(self._ask).read()[names.MOVE_SPEED]), 0
        self._ask("FolMe.XYPosSet", x, y, at_once)
        self._goal_m = (x, y)
        self.arrives_s = self._now_s() + (math.dist(before_m, (x, y)) / speed_m_s if speed_m_s > 0.0 else 0.0)

    def within(self, reach: Mapping[str, ParameterSpec]) -> Mapping[str, ParameterSpec]:
        """Return rows of positions with the scanner's range as Nanonis reports it now, or a narrower one of the file.

        A person may change the range at the panel, and Nanonis takes a frame beyond it without an error: it clips the
        voltages while it scans.
        """
        try:
            self._range_m, self._unknown_range = self._numbers("Piezo.RangeGet")[:2], ""
        except (NanonisError, BadReply) as error:
            self._unknown_range = str(error)
            return reach
        rows = zip(self.names, self._range_m, strict=True)
        found = {name: reach[name].within((-whole / 2, whole / 2), "Nanonis, module Piezo") for name, whole in rows}
        ends_m = zip(self.names, self._ends_of_voltages_m(), strict=True)
        return {
            name: found[name].within(ends, "Nanonis, Piezo: calibration and voltage limits") for name, ends in ends_m
        }

    def look(self, log: logging.Logger) -> None:
        """Warn if Nanonis does not report the voltages of the scanner."""
        try:
            self._voltages()
        except (NanonisError, BadReply) as error:
            log.warning("the scanner's calibration and voltage limits are unknown, so only its range counts: %s", error)

    def _voltages(self) -> tuple[Sequence[float], bool, Sequence[float]]:
        on, *limits_v = self._ask("Piezo.XYZLimitsGet")  # of limits that are off, any number
        if on and not all(map(math.isfinite, limits_v)):
            raise BadReply(f"Nanonis returned {limits_v} in reply to Piezo.XYZLimitsGet")
        return self._numbers("Piezo.CalibrGet")[:2], bool(on), limits_v

    def _ends_of_voltages_m(self) -> list[tuple[float, float]]:
        # (! piezo-range) the range says nothing of voltage limits, which a person sets in the same module
        try:
            metres_per_volt, on, limits_v = self._voltages()
        except (NanonisError, BadReply):
            return [(-math.inf, math.inf)] * 2  # `look` has named it
        ends_m = []
        for axis, factor in enumerate(metres_per_volt):
            low_v, high_v = limits_v[2 * axis : 2 * axis + 2] if on else (-_OUTPUT_V, _OUTPUT_V)
            low_m, high_m = sorted((factor * max(low_v, -_OUTPUT_V), factor * min(high_v, _OUTPUT_V)))
            # limits of 0 V to 0 V, or a calibration of 0, are values that were never set
            ends_m.append((low_m, high_m) if low_m < high_m else (-math.inf, math.inf))
        return ends_m

    def arrived(self) -> bool:
        """Return True if no move is pending, or if the tip has reached the target."""
        if self._goal_m is None:
            return True
        if not self._near(self._numbers("FolMe.XYPosGet", 0), self._goal_m):
            return False
        # the target counts from now on: the measured position is rounded by the converters
        self._seen_m, self._goal_m = self._goal_m, None
        return True

    def give_up(self) -> None:
        """Discard the target, so that the measured position counts."""
        self._goal_m = self._seen_m = None

    def _near(self, a: tuple[float, ...], b: tuple[float, float]) -> bool:
        return all(
            abs(one - other) <= max(1e-6 * abs(other), 0.0 if math.isinf(whole) else self._finest_part * whole)
            for one, other, whole in zip(a, b, self._range_m, strict=True)
        )


def same_float32(name: str, got: Value, other: Value, among: Mapping[str, Value]) -> bool:
    """Return True if two values are equal for a controller that stores most values as float32.

    Args:
        among: values read together with `got`; for a frame, all values of the frame.
    """
    if not (isinstance(got, float) and isinstance(other, float)):
        return got == other
    if name == names.SCAN_ANGLE:  # a controller may return 350 degrees as -10
        return abs(math.remainder(got - other, math.tau)) <= _DIGITS * math.tau
    # A corner is centre minus half the size: its rounding error is relative to the larger of them.
    largest = max(abs(float(among[part])) for part in _ADDED_UP & among.keys()) if name in _ADDED_UP else 0.0
    return math.isclose(got, other, rel_tol=_DIGITS, abs_tol=_DIGITS * largest)
