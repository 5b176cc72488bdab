"""Setting of parameters: all are checked first, then set, then read back; a failure restores the former values."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from afspm.basics.errors import Refused
from afspm.model import (
    ControlResponse,
    Feedback,
    Parameter,
    PositionChange,
    ProbePosition,
    Request,
    ScanParameters,
    names,
)
from afspm.model.positions import scan_values
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.parameters import ParameterSpec, Value, refuse_value
from afspm.translator.setting_groups import FEEDBACK, FRAME, POSITION, check_together

_UNBOUNDED: Final = (-math.inf, math.inf)


def wanted_values(request: Request, driver: DriverBase) -> dict[str, Value] | None:
    """Return the values in SI that a request sets, each checked separately; None if the request only reads.

    A read-only or out-of-range value that equals the present value is no change: peers change one field and send back
    a whole message.

    Raises:
        Refused: PARAM_NOT_SUPPORTED or PARAM_ERROR.
    """
    asked = _values_in(request.subject)
    values: dict[str, Value] = {}
    for name, given in asked.items():
        spec = driver.table.find(name)
        # first without bounds: a value out of bounds that is in force already is no change
        anything = replace(spec, range=_UNBOUNDED, choices=())
        value = (
            anything.parse(given.value or "", given.unit) if isinstance(given, Parameter) else anything.checked(given)
        )
        try:
            values[spec.name] = _settable(spec, value)
        except Refused:
            now = driver.in_force([spec.name])
            if not driver.same(spec.name, now[spec.name], value, now):
                raise
    return values if asked else None


def apply(
    driver: DriverBase, values: Mapping[str, Value], about_to_act: Callable[[], None] = lambda: None
) -> dict[str, Value]:
    """Set values and return them as read back; after an error, unless the controller is lost, restore the former ones.

    Args:
        about_to_act: called after all checks, right before the first change.

    Raises:
        Refused: PARAM_ERROR: the values do not fit together, or the controller set other values.
        an error in `LOST`: the outcome is unknown.
        other errors of the driver.
    """
    table = driver.table
    # the whole frame: when a part of it is set, a controller may change the rest
    framed = FRAME if not values.keys().isdisjoint(FRAME) else ()
    whole = {*values, *(name for name in framed if name in table)}
    # at a controller with a line rate a frame half set changes the speed, too: the speed is restored with the frame
    speed = {names.SCAN_SPEED} & table.keys() if framed else set()
    before = driver.in_force(whole | speed)
    wanted = {**before, **values}
    if framed or not values.keys().isdisjoint(POSITION):
        check_together(wanted, driver.reach(), driver.max_pixels)
    former = {name: value for name, value in before.items() if not table[name].read_only}
    about_to_act()
    try:
        driver.put_in_force(values)
        after = driver.in_force(whole)
    except LOST:
        raise
    except Exception:  # a driver may raise anything, and must not leave a frame half set
        with contextlib.suppress(Exception):  # a driver may raise anything; the first error is reported
            driver.put_in_force(former)
        raise
    for name in whole:
        if not driver.same(name, after[name], wanted[name], after):
            driver.put_in_force(former)
            made, asked = (table[name].quantity(one) for one in (after[name], wanted[name]))
            raise refuse_value(name, f"the controller set {made} instead of {asked}; the former values were restored")
    return after


def _values_in(subject: object) -> dict[str, Parameter | Value]:
    # a parameter keeps its text and unit; all other values are in SI
    if isinstance(subject, Parameter):
        return {} if subject.value is None else {subject.name: subject}
    if isinstance(subject, ScanParameters):
        return dict(scan_values(subject))
    found: dict[str, Value | None] = {}
    if isinstance(subject, Feedback):
        gains = (subject.proportional_gain, subject.integral_gain, subject.setpoint)
        found = dict(zip(FEEDBACK, (subject.on, *gains), strict=True))
    elif isinstance(subject, ProbePosition):
        found = dict(zip(POSITION, subject.xy_m, strict=True))
    elif isinstance(subject, PositionChange):
        found = dict(zip(POSITION, (subject.x_m, subject.y_m), strict=True))
    return {name: value for name, value in found.items() if value is not None}


def _settable(spec: ParameterSpec, value: Value) -> Value:
    if spec.read_only:
        raise Refused(ControlResponse.PARAM_ERROR, f"{spec.name} is read-only")
    # the corner of a frame is computed from its centre, so it may miss the bound by its last bits
    if spec.name in FRAME and isinstance(value, float):
        value = next((end for end in spec.range if math.isclose(value, end, rel_tol=1e-12)), value)
    return spec.checked(value)
