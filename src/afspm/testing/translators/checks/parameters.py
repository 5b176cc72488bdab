"""Checks of each base parameter: reading, setting, setting in another unit, and refusals of impossible values."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.basics.units import convert
from afspm.model import ControlRequest, ControlResponse, Parameter, Response, names
from afspm.testing.conformance import Skipped, expect, near
from afspm.testing.translators.client import answer_in_words, value_in
from afspm.testing.translators.measuring import CheckMeasurements, number
from afspm.testing.translators.translator_suite import check

_SMALLER = {"m": "nm", "m/s": "nm/s", "V": "mV", "deg": "rad", "A": "pA"}
"""Peers may set and read a value in any unit of its kind."""
_NO_VALUES = ("nan", "inf", "-inf", "abc", "")
_BAD_UNIT = "kg"


@dataclass(frozen=True)
class ParameterStep:
    """The change of a parameter in a check: by a factor, from 0 by `from_zero`, or always by `by`."""

    factor: float = 1.02
    from_zero: float = 0.0
    by: float = 0.0

    def from_(self, value: float, sign: int) -> float:
        """Return `value` changed up (`sign` 1) or down (`sign` -1)."""
        if self.by:
            return value + sign * self.by
        return value * self.factor**sign if value else sign * self.from_zero


_STEPS = {
    names.SCAN_ANGLE: ParameterStep(by=2.0),
    names.SCAN_RESOLUTION_X: ParameterStep(by=16),
    names.SCAN_RESOLUTION_Y: ParameterStep(by=16),
    names.SCAN_SIZE_X: ParameterStep(0.9),
    names.SCAN_SIZE_Y: ParameterStep(0.9),
    names.SAMPLE_SLOPE_X: ParameterStep(from_zero=1e-3),
    names.SAMPLE_SLOPE_Y: ParameterStep(from_zero=1e-3),
    names.TIP_BIAS_VOLTAGE: ParameterStep(from_zero=1e-3),
    names.ZCTRL_PGAIN: ParameterStep(from_zero=1e-2),
    names.ZCTRL_IGAIN: ParameterStep(from_zero=1e-2),
}
_PLACES = (names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y, names.PROBE_POS_X, names.PROBE_POS_Y)


def _declare_checks(name: str) -> None:
    what = name.replace("-", " ")

    @check(f"parameter/{name}", f"{what}: set, and reported as it was set, also in another unit", needs=(name,))
    def is_set(kit: CheckMeasurements) -> None:
        _require_set(kit, name)

    @check(f"refused/{name}", f"{what}: NaN, text and a wrong unit are refused, and change nothing", needs=(name,))
    def is_refused(kit: CheckMeasurements) -> None:
        _require_refused(kit, name)


for _name in names.BASE_PARAMETERS:
    _declare_checks(_name)


def _require_set(kit: CheckMeasurements, name: str) -> None:
    client = kit.client
    client.come_to_rest()
    before = client.get(name)
    unit = before.unit or ""
    now = number(before)
    if name in _PLACES:
        step = ParameterStep(by=0.02 * convert(min(kit.frames.whole.size_m), "m", unit))
    else:
        step = _STEPS.get(name, ParameterStep())
    wanted, response = _set_near(kit, name, now, step, unit)
    kit.support.settable[name] = True
    _require_reported(name, value_in(response, name), wanted, unit, "the answer")
    client.settled(client.observations.mark())
    _require_reported(name, client.get(name), wanted, unit, "the value read back")
    if unit in _SMALLER:
        _require_other_unit(kit, name, now, unit)


def _set_near(kit: CheckMeasurements, name: str, now: float, step: ParameterStep, unit: str) -> tuple[float, Response]:
    if step.from_(now, 1) == now:
        raise Skipped(f"{name} is {now:g} and can't be changed by a fraction")
    response = Response(ControlResponse.FAILURE)
    for sign in (1, -1):
        wanted = _written(step.from_(now, sign), name)
        response = kit.client.set(name, wanted, unit or None)
        if response.ok:
            return float(wanted), response
        kit.client.settled(kit.client.observations.mark())
    allowed = response.code in (ControlResponse.PARAM_ERROR, ControlResponse.PARAM_NOT_SUPPORTED)
    expect(allowed, f"REP_SUCCESS or REP_PARAM_ERROR to setting {name} while SS_FREE", answer_in_words(response))
    kit.support.settable[name] = False
    raise Skipped(f"it is read-only: {answer_in_words(response)}")


def _require_other_unit(kit: CheckMeasurements, name: str, value: float, unit: str) -> None:
    other = _SMALLER[unit]
    text = f"{convert(value, unit, other):.12g}"
    response = kit.client.set(name, text, other)
    expect(response.ok, f"REP_SUCCESS to {name} = {text} {other}", answer_in_words(response))
    kit.client.settled(kit.client.observations.mark())
    _require_reported(name, kit.client.get(name), value, unit, f"the value read back after setting {text} {other}")
    _require_reported(name, kit.client.get(name, other), value, unit, f"the value read back in {other}")


def _require_reported(name: str, reported: Parameter, wanted: float, unit: str, where: str) -> None:
    came = number(reported, unit) if unit else number(reported)
    # the gains of some makers are lengths, of a few pm
    absolute = 0.0 if name in (names.ZCTRL_PGAIN, names.ZCTRL_IGAIN) else {"m": 1e-12, "deg": 1e-6}.get(unit, 0.0)
    alike = near(came, wanted, absolute=absolute)
    expect(
        alike,
        f"{name} = {wanted:.6g} {unit}".rstrip() + f" as {where}",
        f"{reported.value} {reported.unit or ''}".rstrip(),
    )


def _written(value: float, name: str) -> str:
    # as a person would write it; pixels are whole numbers
    return str(round(value)) if name in (names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y) else f"{value:.6g}"


def _require_refused(kit: CheckMeasurements, name: str) -> None:
    client = kit.client
    client.come_to_rest()
    before = client.get(name)
    for value in _NO_VALUES:
        require_param_error(kit, name, value, before.unit, before)
    require_param_error(kit, name, str(before.value), _BAD_UNIT, before)


def require_param_error(kit: CheckMeasurements, name: str, value: str, unit: str | None, before: Parameter) -> None:
    """Raise Failed unless the request is refused with REP_PARAM_ERROR and changes nothing."""
    asked = f"{name} = {value!r} {unit or ''}".rstrip()
    response = kit.client.ask_directly(ControlRequest.PARAM, Parameter(name, value, unit))
    expect(response.code == ControlResponse.PARAM_ERROR, f"REP_PARAM_ERROR to {asked}", answer_in_words(response))
    after = kit.client.get(name)
    expect(
        after.value == before.value, f"{name} unchanged, {before.value}, after {asked} was refused", f"{after.value}"
    )
