"""Groups of settings that are read together, checked together and published together."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Final

from afspm.basics.errors import InvalidValue, Refused
from afspm.basics.formatting import lengths_text
from afspm.basics.plain_data import Plain
from afspm.model import ControlResponse, Feedback, ProbePosition, Region, ScanParameters, names
from afspm.translator.parameters import FEEDBACK_ON, ParameterSpec, ParameterTable, Value, refuse_value
from afspm.wire.messages import FEEDBACK as FEEDBACK_STATE
from afspm.wire.messages import PROBE_POSITION, SCAN_PARAMETERS

Published = ScanParameters | Feedback | ProbePosition

FRAME: Final = (
    names.SCAN_TOP_LEFT_X,
    names.SCAN_TOP_LEFT_Y,
    names.SCAN_SIZE_X,
    names.SCAN_SIZE_Y,
    names.SCAN_ANGLE,
    names.SCAN_RESOLUTION_X,
    names.SCAN_RESOLUTION_Y,
)
EXTENT: Final = (names.SCAN_SIZE_X, names.SCAN_RESOLUTION_Y, names.SCAN_RESOLUTION_X, names.SCAN_SIZE_Y)
"""The parameters that a scan's duration depends on, with the speed: certainly width and rows, perhaps the others."""
FEEDBACK: Final = (FEEDBACK_ON, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN, names.ZCTRL_SETPOINT)
POSITION: Final = (names.PROBE_POS_X, names.PROBE_POS_Y)
CENTER: Final = ("x-scan-center-x", "x-scan-center-y")
"""The centre of the frame, at a controller whose offset has a range of its own."""
_FRAME_MESSAGE, _FEEDBACK_MESSAGE, _POSITION_MESSAGE = SCAN_PARAMETERS.name, FEEDBACK_STATE.name, PROBE_POSITION.name

MOVES: Final = frozenset(FRAME + POSITION)


_PLACE: Final = FRAME[:4]
_STAYS: Final = 0.01
"""Largest move of a frame, relative to its size, after which the scanner need not settle, such as one for drift."""
_SAME_SPEED: Final = 0.01
"""Largest difference from the speed that a frame is set with, relative; a line rate may be rounded."""


def moves_scanner(before: Mapping[str, Value], values: Mapping[str, Value]) -> bool:
    """Return whether values that were set, in SI, have moved the frame by more than a hundredth of its size."""
    after = {**before, **values}
    if names.SCAN_SIZE_X not in values.keys() | before.keys() or not MOVES & values.keys():
        return False
    size_m = max(float(after[name]) for name in (names.SCAN_SIZE_X, names.SCAN_SIZE_Y))
    off_m = [float(after[name]) - float(before.get(name, math.inf)) for name in _PLACE if name in values]
    turned = float(after.get(names.SCAN_ANGLE, 0.0)) - float(before.get(names.SCAN_ANGLE, 0.0))
    return max(map(abs, (*off_m, turned * size_m))) > _STAYS * size_m


class SettingsGroup(ABC):
    """Parameters that belong together at a controller, in a form that a table can't describe."""

    names: Collection[str]

    @abstractmethod
    def read(self) -> dict[str, Value]:
        """Return the values in force, by generic names, in SI."""

    @abstractmethod
    def write(self, values: Mapping[str, Value]) -> None:
        """Change some of the values.

        Raises:
            Refused: PARAM_ERROR: the controller would set other values.
        """

    def merged(self, values: Mapping[str, Value]) -> Plain:
        """Return all values of the group, with `values` changed; the others are read from the controller."""
        return dict(values) if values.keys() >= set(self.names) else {**self.read(), **values}


class KeptSettings(SettingsGroup):
    """Settings that are sent to a controller with an action, because the controller does not store them.

    Args:
        at_first: the initial values.
    """

    def __init__(self, at_first: Mapping[str, Value]) -> None:
        self.names = tuple(at_first)
        self._at_first = at_first
        self._kept: dict[str, Value] = {}

    def kept_in(self, memory: Plain) -> None:
        """Keep the values in a memory on disk from now on."""
        self._kept = memory.setdefault("kept", {})
        for name, value in self._at_first.items():
            self._kept.setdefault(name, value)

    def __getitem__(self, name: str) -> Value:
        return self._kept[name]

    def number(self, name: str) -> float:
        return float(self._kept[name])

    def read(self) -> dict[str, Value]:
        return {name: self._kept[name] for name in self.names}

    def write(self, values: Mapping[str, Value]) -> None:
        self._kept.update(values)


class HeldZSettings(KeptSettings):
    """The settings of a held z, which no controller has: the translator keeps and applies them (`held_z`).

    Attributes:
        moves: called with a new offset in m, before it is kept.
        is_held: returns whether z is held.
    """

    def __init__(self) -> None:
        super().__init__({**dict.fromkeys(names.OF_HELD_Z, 0.0), names.HELD_Z_SPEED: 100e-12})
        self._kept = dict(self._at_first)
        self.names = (*self.names, names.Z_IS_HELD)
        self.moves: Callable[[float], None] = lambda offset_m: None
        self.is_held: Callable[[], bool] = lambda: False

    def read(self) -> dict[str, Value]:
        return {**self._kept, names.Z_IS_HELD: self.is_held()}

    def write(self, values: Mapping[str, Value]) -> None:
        offset_m = values.get(names.HELD_Z_OFFSET)
        if offset_m is not None:
            self.moves(float(offset_m))
        self.keep(values)

    def keep(self, values: Mapping[str, Value]) -> None:
        """Keep values without moving the tip."""
        super().write(values)


def check_speed(wanted_m_s: float, made_m_s: float) -> None:
    """Refuse a frame that a controller would scan at another speed, for example for lack of so slow a line rate.

    Raises:
        Refused: PARAM_ERROR.
    """
    if not math.isclose(wanted_m_s, made_m_s, rel_tol=_SAME_SPEED):
        made, wanted = (f"{speed_m_s * 1e6:.6g} µm/s" for speed_m_s in (made_m_s, wanted_m_s))
        raise refuse_value(names.SCAN_SPEED, f"the controller would scan this frame at {made} instead of {wanted}")


def watched(table: ParameterTable) -> list[str]:
    """Return the parameters of this microscope whose changes are published."""
    return [name for name in (*FRAME, *FEEDBACK, names.ENGAGED, *POSITION) if name in table]


def messages(values: Mapping[str, Value]) -> dict[str, Published]:
    """Return the messages to publish, by name, as far as `values` has their parameters.

    Scan parameters may lack the angle; a feedback message needs only one of its parameters.
    """
    published: dict[str, Published] = {}
    if all(name in values for name in FRAME if name != names.SCAN_ANGLE):
        published[_FRAME_MESSAGE] = scan_parameters(values)
    if any(name in values for name in FEEDBACK):
        published[_FEEDBACK_MESSAGE] = feedback(values)
    if all(name in values for name in POSITION):
        published[_POSITION_MESSAGE] = ProbePosition((_number(values, POSITION[0]), _number(values, POSITION[1])))
    return published


def of_message(message: str) -> tuple[str, ...]:
    """Return the parameters that a published message contains."""
    return {_FRAME_MESSAGE: FRAME, _FEEDBACK_MESSAGE: FEEDBACK, _POSITION_MESSAGE: POSITION}[message]


def scan_parameters(values: Mapping[str, Value]) -> ScanParameters:
    return ScanParameters(*frame(values))


def frame(values: Mapping[str, Value]) -> tuple[Region, tuple[int, int]]:
    """Return the region and (rows, columns) of the frame in `values`.

    Raises:
        InvalidValue: the values describe no frame.
    """
    corner = (_number(values, names.SCAN_TOP_LEFT_X), _number(values, names.SCAN_TOP_LEFT_Y))
    size = (_number(values, names.SCAN_SIZE_X), _number(values, names.SCAN_SIZE_Y))
    region = Region.from_top_left(corner, size, _number(values, names.SCAN_ANGLE, 0.0))
    shape = (int(_number(values, names.SCAN_RESOLUTION_Y)), int(_number(values, names.SCAN_RESOLUTION_X)))
    return region, shape


def as_list(region: Region) -> list[float]:
    """Return a frame as a list for JSON."""
    return [*region.center_m, *region.size_m, region.angle_rad]


def as_region(kept: Sequence[float]) -> Region:
    """Return the frame of a list made by `as_list`."""
    x, y, width, height, angle_rad = kept
    return Region((x, y), (width, height), angle_rad)


def frame_values(region: Region, shape: tuple[int, int]) -> dict[str, Value]:
    """Return the values of a frame by generic names, in SI: the reverse of `frame`."""
    corner, size, (rows, columns) = region.top_left_m, region.size_m, shape
    return dict(zip(FRAME, (*corner, *size, region.angle_rad, columns, rows), strict=True))


def feedback(values: Mapping[str, Value]) -> Feedback:
    """Return the z feedback in `values`.

    For a withdrawn tip, the state "off" is left out: a feedback that is off is a danger only at the sample.
    """
    on = values.get(FEEDBACK_ON)
    is_away = values.get(names.ENGAGED) is False
    return Feedback(
        on=None if on is None or (is_away and not on) else bool(on),
        proportional_gain=_optional(values, names.ZCTRL_PGAIN),
        integral_gain=_optional(values, names.ZCTRL_IGAIN),
        setpoint=_optional(values, names.ZCTRL_SETPOINT),
    )


def check_together(values: Mapping[str, Value], reach: Mapping[str, ParameterSpec], max_pixels: int) -> None:
    """Compare a frame with the number of pixels and the range of the scanner, and a position with this range.

    A frame that is not complete in `values` is not compared.

    Args:
        reach: the ranges of the scanner, by the names of `POSITION` and `CENTER`, as `DriverBase.reach` returns them.

    Raises:
        Refused: PARAM_ERROR.
    """
    for name in POSITION:
        if name in values and name in reach and not _is_inside(reach[name], _number(values, name)):
            place = lengths_text([_number(values, name)])
            raise refuse_value(name, f"{place} is beyond the scanner's {_range_text(reach[name])}")
    if not all(name in values for name in FRAME if name != names.SCAN_ANGLE):
        return
    try:
        region, (rows, columns) = frame(values)
    except InvalidValue as error:
        raise Refused(ControlResponse.PARAM_ERROR, str(error)) from error
    if rows * columns > max_pixels:
        raise refuse_value(
            "scan-resolution", f"{columns} x {rows} pixels exceed the {max_pixels} that this microscope takes"
        )
    if why := frame_outside(region, reach):
        raise refuse_value("scan frame", why)


def reach_in(table: ParameterTable) -> dict[str, ParameterSpec]:
    """Return the rows of a table that have the range of the scanner."""
    return {name: table[name] for name in (*POSITION, *CENTER) if name in table}


def frame_outside(region: Region, reach: Mapping[str, ParameterSpec]) -> str:
    """Return why a frame, with its angle, does not fit into the range of the scanner; empty if it fits."""
    corners_m = region.corners_m().T.tolist()
    parts = [(name, "its corners are", corners_m[axis]) for axis, name in enumerate(POSITION)]
    parts += [(name, "its centre is", [region.center_m[axis]]) for axis, name in enumerate(CENTER)]
    for name, what, places_m in parts:
        if name not in reach:
            continue
        first_m, last_m = min(places_m), max(places_m)
        # the corners are computed, so their last bits may miss a bound that the frame touches
        slack_m = 1e-9 * max(abs(first_m), abs(last_m), *region.size_m)
        if _is_inside(reach[name], first_m, slack_m) and _is_inside(reach[name], last_m, slack_m):
            continue
        low_m, high_m = reach[name].range
        too_far_m = last_m - first_m - (high_m - low_m)
        remedy = f"move the frame by {lengths_text([max(low_m - first_m, 0.0) or high_m - last_m])} in {name[-1]}"
        if too_far_m > slack_m:
            remedy = f"make it smaller, or turn it: they are {lengths_text([too_far_m])} too far apart"
        ends = lengths_text(sorted({first_m, last_m}), " to ")
        return f"{what} at {ends} in {name[-1]}, beyond the scanner's {_range_text(reach[name])}; {remedy}"
    return ""


def _is_inside(row: ParameterSpec, value_m: float, slack_m: float = 0.0) -> bool:
    low_m, high_m = row.range
    return low_m - slack_m <= value_m <= high_m + slack_m


def _range_text(row: ParameterSpec) -> str:
    text = lengths_text(row.range, " to ")
    return f"{text} (set in {row.where})" if row.where else text


def _number(values: Mapping[str, Value], name: str, default: float | None = None) -> float:
    value = values[name] if default is None else values.get(name, default)
    return float(value)


def _optional(values: Mapping[str, Value], name: str) -> float | None:
    return _number(values, name) if name in values else None
