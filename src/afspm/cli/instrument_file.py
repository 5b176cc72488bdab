"""The file of an instrument, from the answers of its controller: to be laid over any experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

from afspm.basics.formatting import quantity
from afspm.experiment.toml_writer import value
from afspm.model import ChannelRoles, names
from afspm.model.variables import RETRACE
from afspm.translator.contact import MOST, Contact, ParameterReading

_LEAST_BIAS_V: Final = 1.0
_BIAS_FACTOR: Final = 2.0
_OF_CURRENT: Final = ((0.1, MOST), f"from a tenth to {MOST:g} times that")
_OF_AMPLITUDE: Final = ((0.5, 1.5), "half of that to each side")
_AXES: Final = {"x": ("x-scan-center-x", names.PROBE_POS_X), "y": ("x-scan-center-y", names.PROBE_POS_Y)}


class _Proposal(NamedTuple):
    name: str
    low: float
    high: float
    step: float
    unit: str
    why: str


def text_of(class_name: str, channels: ChannelRoles, found: Contact, day: str) -> str:
    """Return the file, with the reason for each proposed limit.

    Args:
        day: on which the controller was asked.
    """
    known = found.answers.get(names.CONTROLLER)
    head = class_name if known is None or known.value is None else " ".join(str(known.value).split())
    lines = [
        f"# {head}: read on {day}. To be laid over any experiment: afspm run EXPERIMENT.toml THIS.toml",
        "# Each limit is a proposal from what was in force then: change it to what you allow.",
        "",
        "[clock]",
        "replaces = true  # a sample may run faster than real time",
        "",
        "[microscope]",
        "replaces = true  # nothing stays of the simulated microscope of a sample",
        "component = true",
        f"class = {value(class_name)}",
        f"address = {value(found.address)}",
        '# channels by role, as the driver knows them; others are named so: channels = { height = "Z" }',
        *(f"#   {role}: {' or '.join(known)}" for role, known in channels.names.items() if RETRACE not in role),
        "",
        "[limits]",
        *_region(found),
    ]
    for one in (*_bias(found.answers), *_setpoint(found)):
        lines += ["", f"[limits.{one.name}]  # {one.why}"]
        bounds = {"min": one.low, "max": one.high, "step": one.step}
        lines += [f"{key} = {value(_text(bound, one.unit))}" for key, bound in bounds.items()]
    return "\n".join(lines) + "\n"


def _region(found: Contact) -> Iterator[str]:
    sides = []
    for axis, known in _AXES.items():
        ends = next((found.reach[name].range for name in known if name in found.reach), None)
        if ends is None:
            yield "# region: the driver does not know the scanner's range: set one before the first scan"
            return
        sides.append(f"{axis} = {value([_text(end, 'm') for end in ends])}")
    yield f"region = {{ replaces = true, {', '.join(sides)} }}  # the scanner's range, as far as the driver knows it"


def _bias(answers: Mapping[str, ParameterReading]) -> Iterator[_Proposal]:
    if (bias_v := _number(answers.get(names.TIP_BIAS_VOLTAGE))) is not None:
        most = max(_LEAST_BIAS_V, _BIAS_FACTOR * abs(bias_v))
        why = f"{quantity(bias_v, 'V')} was in force: twice that to each side, at least 1 V"
        yield _Proposal(names.TIP_BIAS_VOLTAGE, -most, most, most, "V", why)


def _setpoint(found: Contact) -> Iterator[_Proposal]:
    answer = found.answers.get(names.ZCTRL_SETPOINT)
    setpoint = _number(answer)
    if answer is None or not setpoint:
        return
    unit = answer.row.si_unit
    factors, way = _OF_CURRENT if unit == "A" else _OF_AMPLITUDE
    low, high = sorted(setpoint * factor for factor in factors)
    why = f"{quantity(setpoint, unit)} was in force: {way}"
    if found.most_setpoint is not None:
        low, high = (low, found.most_setpoint) if setpoint > 0 else (found.most_setpoint, high)
        why = f"{why}, within the preamplifier's reach"
    yield _Proposal(names.ZCTRL_SETPOINT, low, high, abs(setpoint), unit, why)


def _number(answer: ParameterReading | None) -> float | None:
    return answer.value if answer is not None and type(answer.value) is float else None


def _text(number: float, unit: str) -> str:
    return quantity(number, unit, 6) if unit else f"{number:.6g}"
