"""What a request asks to be set, as generic parameters: only the fields that are present (wire format).

The messages are read here as they came, each number with the unit that its peer gave: a refusal is told in that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from google.protobuf.message import DecodeError, Message

from afspm.errors import Refused
from afspm.model import ControlRequest, ControlResponse, names
from afspm.translator.parameters import FEEDBACK_ON, ParameterSpec, ParameterTable, Value
from afspm.wire import messages
from afspm.wire.mapping import shortest

_ANY: Final = (-math.inf, math.inf)


@dataclass(frozen=True)
class AskedValue:
    """One value as the peer gave it; a text is parsed by the parameter's own type."""

    name: str
    value: str | float | bool
    unit: str | None


def _scan_parameters(message: messages.ScanParameters2d) -> Iterator[AskedValue]:
    spatial, roi, shape = message.spatial, message.spatial.roi, message.data.shape
    length, angle = spatial.length_units or None, spatial.angular_units or None
    for name, part, axis, unit in (
        (names.SCAN_TOP_LEFT_X, roi.top_left, "x", length),
        (names.SCAN_TOP_LEFT_Y, roi.top_left, "y", length),
        (names.SCAN_SIZE_X, roi.size, "x", length),
        (names.SCAN_SIZE_Y, roi.size, "y", length),
        (names.SCAN_ANGLE, roi, "angle", angle),
        (names.SCAN_RESOLUTION_X, shape, "x", None),
        (names.SCAN_RESOLUTION_Y, shape, "y", None),
    ):
        if part.HasField(axis):
            yield AskedValue(name, getattr(part, axis), unit)


def _feedback(message: messages.ZCtrlParameters) -> Iterator[AskedValue]:
    for name, field in (
        (FEEDBACK_ON, "feedbackOn"),
        (names.ZCTRL_PGAIN, "proportionalGain"),
        (names.ZCTRL_IGAIN, "integralGain"),
        (names.ZCTRL_SETPOINT, "setPoint"),
    ):
        if message.HasField(field):
            value = getattr(message, field)
            yield AskedValue(name, value if isinstance(value, bool) else shortest(value), None)


def _probe_position(message: messages.ProbePosition) -> Iterator[AskedValue]:
    for name, axis in ((names.PROBE_POS_X, "x"), (names.PROBE_POS_Y, "y")):
        if message.point.HasField(axis):
            yield AskedValue(name, getattr(message.point, axis), message.units or None)


def _parameter(message: messages.ParameterMsg) -> Iterator[AskedValue]:
    if message.HasField("value"):
        yield AskedValue(message.parameter, message.value, message.units or None)


_READERS = {
    ControlRequest.SET_SCAN_PARAMS: (messages.ScanParameters2d, _scan_parameters),
    ControlRequest.SET_ZCTRL_PARAMS: (messages.ZCtrlParameters, _feedback),
    ControlRequest.SET_PROBE_POS: (messages.ProbePosition, _probe_position),
    ControlRequest.PARAM: (messages.ParameterMsg, _parameter),
}


def asked_for(kind: int, payload: bytes) -> list[AskedValue]:
    """What a request to set something asks for; empty if it only gets.

    Raises:
        Refused: PARAM_ERROR: the object is not what belongs to the request.
    """
    message_class, reader = _READERS[ControlRequest(kind)]
    message: Message = message_class()
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        reason = f"the object of the request is not a {message.DESCRIPTOR.name}: {error}"
        raise Refused(ControlResponse.PARAM_ERROR, reason) from error
    return list(reader(message))  # type: ignore[operator]


def wanted_values(
    asked: list[AskedValue], table: ParameterTable, is_in_force: Callable[[str, Value], bool]
) -> dict[str, Value]:
    """Return what is asked for in SI, each value checked by itself.

    A value that can't be set, and is in force, is no change: peers send back a whole message in which they have changed
    one field.

    Raises:
        Refused: PARAM_NOT_SUPPORTED or PARAM_ERROR.
    """
    values: dict[str, Value] = {}
    for one in asked:
        spec = table.find(one.name)
        value = _value(one, replace(spec, range=_ANY, choices=()))
        try:
            values[spec.name] = _settable(spec, value)
        except Refused:
            if not is_in_force(spec.name, value):
                raise
    return values


def _value(one: AskedValue, spec: ParameterSpec) -> Value:
    if isinstance(one.value, str):
        return spec.parse(one.value, one.unit)
    return spec.checked(one.value if isinstance(one.value, bool) else spec.from_unit(one.value, one.unit))


def _settable(spec: ParameterSpec, value: Value) -> Value:
    if spec.read_only:
        raise Refused(ControlResponse.PARAM_ERROR, f"{spec.name} can be asked for, not set")
    return spec.checked(value)
