"""Setting of parameters: all are checked first, then set, then read back; a failure restores the former values."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Mapping
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
    driver: DriverBase,
    values: Mapping[str, Value],
    about_to_act: Callable[[], None] = lambda: None,
    by_hand: Callable[[Mapping[str, Value], Mapping[str, Value]], None] = lambda before, after: None,
) -> dict[str, Value]:
    """Set values and return them as read back; after an error, unless the controller is lost, restore the former ones.

    A value read back that is neither the wanted nor the former one may be a person's, set at this moment. It is set
    once more: a controller that rounds or clamps values gives the same one again, and is refused.

    Args:
        about_to_act: called after all checks, right before the first change.
        by_hand: called with values before and after each change by a person meanwhile, and before and after they are
            set again.

    Raises:
        Refused: PARAM_ERROR: the values do not fit together, or the controller set other values. NOT_FREE: a person
            keeps changing them; nothing is restored.
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
    driver.refuse_unreachable(values, before)
    former = {name: value for name, value in before.items() if not table[name].read_only}

    def other(now: Mapping[str, Value], than: Mapping[str, Value]) -> dict[str, Value]:
        return {name: now[name] for name in whole if not driver.same(name, now[name], than[name], now)}

    about_to_act()
    try:
        after, refused = _set(driver, values, whole)
        found = other(after, wanted)
        # a part of the frame that is not set, and a value that stays, are the controller's doing
        is_possible = found.keys() <= other(after, before).keys() & values.keys()
        if found and is_possible and not any(table[name].measured for name in found):
            first, (after, refused) = after, _set(driver, values, whole)
            found_again = other(after, wanted)
            if not found_again and refused is None:
                by_hand(wanted, found)
                by_hand(found, {name: wanted[name] for name in found})
            elif found_again and other(after, first):
                by_hand(wanted, found_again)
                raise PersonActs(", ".join(sorted(found_again)))
        if refused is not None:
            raise refused
    except (*LOST, PersonActs):
        raise
    except Exception:  # a driver may raise anything, and must not leave a frame half set
        with contextlib.suppress(Exception):  # a driver may raise anything; the first error is reported
            driver.put_in_force(former)
        raise
    for name in other(after, wanted):
        driver.put_in_force(former)
        made, asked = (table[name].quantity(one) for one in (after[name], wanted[name]))
        apart = ""
        if made == asked and isinstance(after[name], float):  # equal in the digits shown
            off = table[name].quantity(abs(float(after[name]) - float(wanted[name])))
            apart = f", {off} off: if that is its precision, its row needs a `resolution`"
        what = f"the controller set {made} instead of {asked}{apart}; the former values were restored"
        raise refuse_value(name, what)
    return after


class PersonActs(Refused):
    """The refusal of values that a person keeps changing at the panel; afspm does not set them back."""

    def __init__(self, changed: str) -> None:
        why = "a person at the panel keeps changing it, or its reading has noise: then its row needs a `resolution`"
        super().__init__(ControlResponse.NOT_FREE, f"{changed}: {why}")


def _set(
    driver: DriverBase, values: Mapping[str, Value], whole: Collection[str]
) -> tuple[dict[str, Value], Refused | None]:
    refused = None
    try:
        driver.put_in_force(values)
    except Refused as error:  # also of a driver that reads back by itself
        refused = error
    return driver.in_force(whole), refused


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
