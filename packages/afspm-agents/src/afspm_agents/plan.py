"""Plan of an agent: steps, canonical form, id, and requests to the microscope. Pure."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from afspm.basics import AfspmError, InvalidValue, area_text, convert, from_json, parse_quantity, position_text, si
from afspm.client import ScanTarget, SpectrumTarget, to_parameter
from afspm.model import XY, ControlRequest, Frame, GrantedStep, Parameter, ProbePosition, Region, names
from afspm.wire import encode_subject

MOST_STEPS = 200
MOST_PIXELS = 4096
LONGEST_TITLE = 200
_FARTHEST_M = 1.0
# a model copies an example: one metre is no size for a microscope
_EXAMPLES = {"m": "100 nm", "m/s": "1 um/s", "V": "0.5 V", "A": "100 pA"}
_ACTION, _PARAM = int(ControlRequest.ACTION), int(ControlRequest.PARAM)


@dataclass(frozen=True)
class PlannedRequest:
    """A request of a plan, with a description for people."""

    kind: int
    subject: object
    text: str

    @property
    def step(self) -> GrantedStep:
        """The request in its encoded form, which the scheduler compares with the approval."""
        return GrantedStep(self.kind, encode_subject(self.subject))


@dataclass(frozen=True)
class ScanStep:
    """Step that takes a scan. Lengths in m, angle in rad, shape in (rows, columns)."""

    center_m: XY
    size_m: XY
    angle_rad: float
    shape: tuple[int, int]

    def target(self, frame: Frame) -> ScanTarget:
        return ScanTarget.of(Region(self.center_m, self.size_m, self.angle_rad), self.shape, frame)

    def requests(self, frame: Frame) -> list[PlannedRequest]:
        turned = f", turned by {math.degrees(self.angle_rad):.4g}°" if self.angle_rad else ""
        where = f"{area_text(self.size_m)} at {position_text(self.center_m)}{turned}"
        text = f"scan {where}, {self.shape[0]} x {self.shape[1]} pixels"
        place = PlannedRequest(int(ControlRequest.SET_SCAN_PARAMS), self.target(frame).parameters, f"place: {where}")
        return [place, PlannedRequest(_ACTION, names.START_SCAN, text)]


@dataclass(frozen=True)
class SpectrumStep:
    """Step that takes a spectrum at a place."""

    at_m: XY

    def target(self, frame: Frame) -> SpectrumTarget:
        return SpectrumTarget.of(self.at_m, None, frame)

    def requests(self, frame: Frame) -> list[PlannedRequest]:
        text = f"spectrum at {position_text(self.at_m)}"
        return [*MoveStep(self.at_m).requests(frame), PlannedRequest(_ACTION, names.START_SPEC, text)]


@dataclass(frozen=True)
class SetStep:
    """Step that sets a parameter; `value` is a quantity (with a unit if the parameter has one), or a word."""

    parameter: str
    value: str

    @property
    def wanted(self) -> Parameter:
        return to_parameter(self.parameter, self.value, None)

    def requests(self, frame: Frame) -> list[PlannedRequest]:
        return [PlannedRequest(_PARAM, self.wanted, f"set {self.parameter} to {self.value}")]


@dataclass(frozen=True)
class MoveStep:
    """Step that moves the probe to a place."""

    to_m: XY

    def requests(self, frame: Frame) -> list[PlannedRequest]:
        text = f"move the probe to {position_text(self.to_m)}"
        return [PlannedRequest(int(ControlRequest.SET_PROBE_POS), ProbePosition(self.to_m), text)]


Step = ScanStep | SpectrumStep | SetStep | MoveStep


@dataclass(frozen=True)
class Plan:
    """A title, which the agent writes for people, and steps in order. The id is a hash of both."""

    title: str
    steps: tuple[Step, ...]

    def canonical(self) -> str:
        """Return the plan as JSON; equal plans give the same text."""
        facts = {"title": self.title, "steps": [_facts(one) for one in self.steps]}
        return json.dumps(facts, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)

    @property
    def id(self) -> str:
        """The first 16 hexadecimal digits of the SHA-256 of the canonical form."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()[:16]

    def requests(self, frame: Frame) -> list[PlannedRequest]:
        """Return all requests to the microscope, in order."""
        return [request for step in self.steps for request in step.requests(frame)]


def read_plan(plain: object) -> Plan:
    """Return the plan described by a tool's arguments.

    Raises:
        InvalidValue: a field is unknown, missing or out of bounds, or a quantity has no unit or is not finite.
    """
    table = _table(plain, "plan", ("title", "steps"))
    steps = table["steps"]
    if isinstance(steps, str) or not isinstance(steps, Sequence) or not 1 <= len(steps) <= MOST_STEPS:
        raise InvalidValue("the plan has no list of steps", where="steps", hint=f"1 to {MOST_STEPS} steps")
    title = table["title"]
    if not isinstance(title, str) or not 0 < len(title) <= LONGEST_TITLE:
        raise InvalidValue("the plan has no title", where="title", hint=f"1 to {LONGEST_TITLE} characters")
    return Plan(title, tuple(read_step(one, f"steps[{i}]") for i, one in enumerate(steps)))


def read_step(plain: object, where: str = "step") -> Step:
    """Return the step described by a JSON object; raise InvalidValue as `read_plan` does."""
    if not isinstance(plain, Mapping):
        raise InvalidValue("a step is an object", where=where)
    match plain.get("do"):
        case "scan":
            given = _table(plain, where, ("do", "center", "size", "pixels"), ("angle",))
            width_m, height_m = size = _pair(given["size"], f"{where}.size")
            if min(width_m, height_m) <= 0.0:
                raise InvalidValue("a scan has a width and a height above zero", where=f"{where}.size")
            angle_rad = _quantity(given.get("angle", "0 deg"), "rad", f"{where}.angle")
            return ScanStep(_pair(given["center"], f"{where}.center"), size, angle_rad, _shape(given["pixels"], where))
        case "spectrum":
            given = _table(plain, where, ("do", "at"))
            return SpectrumStep(_pair(given["at"], f"{where}.at"))
        case "move":
            given = _table(plain, where, ("do", "to"))
            return MoveStep(_pair(given["to"], f"{where}.to"))
        case "set":
            given = _table(plain, where, ("do", "parameter", "value"))
            return _set_step(given, where)
    raise InvalidValue("`do` is scan, spectrum, move or set", where=where)


def plan_of(canonical: str) -> Plan:
    """Return the plan with a given canonical form. Raises InvalidValue if the text is not canonical."""
    try:
        facts = from_json(canonical)
        plan = Plan(str(facts["title"]), tuple(_step_of(one) for one in facts["steps"]))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InvalidValue(f"this is not the canonical form of a plan: {error}") from error
    if plan.canonical() != canonical:
        raise InvalidValue("this is not the canonical form of a plan")
    return plan


def title_of(canonical: str) -> str:
    """Return the title in a plan's canonical form, as the agent wrote it; empty if the text is not a plan."""
    try:
        title = from_json(canonical)["title"]
    except (ValueError, KeyError, TypeError):
        return ""
    return title if isinstance(title, str) else ""


def _facts(step: Step) -> dict[str, object]:
    match step:
        case ScanStep():
            return {
                "do": "scan", "center_m": step.center_m, "size_m": step.size_m, "angle_rad": step.angle_rad,
                "pixels": step.shape,
            }  # fmt: skip
        case SpectrumStep():
            return {"do": "spectrum", "at_m": step.at_m}
        case SetStep():
            return {"do": "set", "parameter": step.parameter, "value": step.value}
        case MoveStep():
            return {"do": "move", "to_m": step.to_m}


def _step_of(facts: Mapping[str, object]) -> Step:
    def lengths(key: str) -> list[str]:
        pair = facts[key]
        if not isinstance(pair, list):
            raise TypeError(f"{key} is no list")
        return [f"{float(one)!r} m" for one in pair]

    match facts["do"]:
        case "scan":
            angle = f"{float(str(facts['angle_rad']))!r} rad"
            plain = {"center": lengths("center_m"), "size": lengths("size_m"), "pixels": facts["pixels"]}
            return read_step({"do": "scan", **plain, "angle": angle})
        case "spectrum":
            return read_step({"do": "spectrum", "at": lengths("at_m")})
        case "move":
            return read_step({"do": "move", "to": lengths("to_m")})
    return read_step(facts)


def _set_step(given: Mapping[str, object], where: str) -> SetStep:
    name, value = given["parameter"], given["value"]
    is_name = isinstance(name, str) and name.replace("-", "").replace(".", "").replace("_", "").isalnum()
    if not isinstance(name, str) or not is_name or len(name) > 100:
        raise InvalidValue("a parameter has a name", where=f"{where}.parameter")
    if name == names.BIAS_OF_SAMPLE:  # the scheduler would take the request for another than the approved one
        hint = f"name {names.TIP_BIAS_VOLTAGE}, with the sign at the panel"
        raise InvalidValue(f"a plan can't set {name}", where=f"{where}.parameter", hint=hint)
    if not isinstance(value, str) or not 0 < len(value) <= 100 or not value.isprintable():
        raise InvalidValue("a value is text: a quantity with its unit, or a word", where=f"{where}.value")
    if value[:1] in "+-.0123456789":
        try:
            number, unit = parse_quantity(value)
        except AfspmError as error:
            raise InvalidValue(error.what, where=f"{where}.value", hint=error.hint) from error
        if not math.isfinite(number):
            raise InvalidValue(f"{value} is not finite", where=f"{where}.value")
        if base := names.BASE_PARAMETERS.get(name):
            example = f'such as "{_EXAMPLES.get(base, f"1 {base}")}"'
            if not unit:
                raise InvalidValue(f"{value} has no unit", where=f"{where}.value", hint=example)
            try:
                convert(1.0, unit, base)
            except AfspmError as error:
                raise InvalidValue(f"{value} is no value of {name}", where=f"{where}.value", hint=example) from error
    elif value.split()[0].lower() in ("nan", "inf", "infinity"):
        raise InvalidValue(f"{value} is not finite", where=f"{where}.value")
    return SetStep(name, value)


def _table(plain: object, where: str, needed: Sequence[str], optional: Sequence[str] = ()) -> Mapping[str, object]:
    if not isinstance(plain, Mapping):
        raise InvalidValue("this is not an object", where=where)
    unknown = [str(key)[:40] for key in plain if key not in (*needed, *optional)]
    missing = [key for key in needed if key not in plain]
    if unknown or missing:
        what = f"unknown: {', '.join(unknown)}" if unknown else f"missing: {', '.join(missing)}"
        raise InvalidValue(what, where=where, hint=f"fields: {', '.join((*needed, *optional))}")
    return plain


def _pair(value: object, where: str) -> XY:
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise InvalidValue("this is not a pair", where=where, hint='as in ["10 nm", "0 nm"]')
    x, y = (_quantity(one, "m", where) for one in value)
    if max(abs(x), abs(y)) > _FARTHEST_M:
        raise InvalidValue("a length above one metre", where=where)
    return (x, y)


def _quantity(value: object, unit: str, where: str) -> float:
    if not isinstance(value, str) or not parse_unit(value, where):
        raise InvalidValue(
            "a quantity is text with a unit", where=where, hint=f'as in "{_EXAMPLES.get(unit, f"1 {unit}")}"'
        )
    try:
        number = si(value, unit)
    except AfspmError as error:
        raise InvalidValue(error.what, where=where, hint=error.hint) from error
    if not math.isfinite(number):
        raise InvalidValue("this is not finite", where=where)
    return number + 0.0  # no negative zero, which would be another plan


def parse_unit(text: str, where: str) -> str:
    """Return the unit of a quantity; "" for a plain number. Raises InvalidValue if the text is not a quantity."""
    try:
        return parse_quantity(text)[1]
    except AfspmError as error:
        raise InvalidValue(error.what, where=where, hint=error.hint) from error


def _shape(value: object, where: str) -> tuple[int, int]:
    if isinstance(value, str) or not isinstance(value, Sequence) or len(value) != 2:
        raise InvalidValue("pixels are [rows, columns]", where=f"{where}.pixels")
    rows, columns = value
    for one in (rows, columns):
        if isinstance(one, bool) or not isinstance(one, int) or not 1 <= one <= MOST_PIXELS:
            raise InvalidValue(f"whole numbers from 1 to {MOST_PIXELS}", where=f"{where}.pixels")
    return (rows, columns)
