"""Each base parameter by itself: got, set, set in another unit, and refused what can't be."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.model import ControlRequest, ControlResponse, Parameter, Response, names
from afspm.testing.translators.bench import answer_in_words, value_in
from afspm.testing.translators.registry import check
from afspm.testing.translators.taking import Taking, number
from afspm.testing.translators.verdicts import Skipped, expect, near
from afspm.units import convert

_SMALLER = {"m": "nm", "m/s": "nm/s", "V": "mV", "deg": "rad", "A": "pA"}
"""A peer may give and ask for a value in any unit of its kind."""
_NO_VALUES = ("nan", "inf", "-inf", "abc", "")
_BAD_UNIT = "kg"


@dataclass(frozen=True)
class Step:
    """By how much a parameter is changed for a check: by a factor, by an amount where it is 0, or by an amount."""

    factor: float = 1.02
    from_zero: float = 0.0
    by: float = 0.0

    def from_(self, value: float, sign: int) -> float:
        """Another value near by."""
        if self.by:
            return value + sign * self.by
        return value * self.factor**sign if value else sign * self.from_zero


_STEPS = {
    names.SCAN_ANGLE: Step(by=2.0),
    names.SCAN_RESOLUTION_X: Step(by=16),
    names.SCAN_RESOLUTION_Y: Step(by=16),
    names.SCAN_SIZE_X: Step(0.9),
    names.SCAN_SIZE_Y: Step(0.9),
    names.SAMPLE_SLOPE_X: Step(from_zero=1e-3),
    names.SAMPLE_SLOPE_Y: Step(from_zero=1e-3),
    names.TIP_BIAS_VOLTAGE: Step(from_zero=1e-3),
    names.ZCTRL_PGAIN: Step(from_zero=1e-2),
    names.ZCTRL_IGAIN: Step(from_zero=1e-2),
}
_PLACES = (names.SCAN_TOP_LEFT_X, names.SCAN_TOP_LEFT_Y, names.PROBE_POS_X, names.PROBE_POS_Y)


def _of(name: str) -> None:
    """Marks the checks of one parameter."""
    what = name.replace("-", " ")

    @check(f"parameter/{name}", f"{what}: set, told as it was set, also in another unit", needs=(name,))
    def is_set(kit: Taking) -> None:
        _require_set(kit, name)

    @check(f"refused/{name}", f"{what}: NaN, no number and a wrong unit are refused, and change nothing", needs=(name,))
    def is_refused(kit: Taking) -> None:
        _require_refused(kit, name)


for _name in names.BASE_PARAMETERS:
    _of(_name)


def _require_set(kit: Taking, name: str) -> None:
    bench = kit.bench
    bench.come_to_rest()
    before = bench.get(name)
    unit = before.unit or ""
    now = number(before)
    if name in _PLACES:
        step = Step(by=0.02 * convert(min(kit.frames.whole.size_m), "m", unit))
    else:
        step = _STEPS.get(name, Step())
    wanted, response = _set_near(kit, name, now, step, unit)
    kit.support.settable[name] = True
    _require_told(name, value_in(response, name), wanted, unit, "the answer")
    bench.settled(bench.story.mark())
    _require_told(name, bench.get(name), wanted, unit, "what is then got")
    if unit in _SMALLER:
        _require_other_unit(kit, name, now, unit)


def _set_near(kit: Taking, name: str, now: float, step: Step, unit: str) -> tuple[float, Response]:
    """A value near the one in force, and the success of setting it.

    Raises:
        Skipped: the microscope lets none be set.
    """
    if step.from_(now, 1) == now:
        raise Skipped(f"{name} is {now:g}, which can't be changed by a little")
    response = Response(ControlResponse.FAILURE)
    for sign in (1, -1):
        wanted = _written(step.from_(now, sign), name)
        response = kit.bench.set(name, wanted, unit or None)
        if response.ok:
            return float(wanted), response
        kit.bench.settled(kit.bench.story.mark())
    allowed = response.code in (ControlResponse.PARAM_ERROR, ControlResponse.PARAM_NOT_SUPPORTED)
    expect(allowed, f"REP_SUCCESS or REP_PARAM_ERROR to setting {name} while SS_FREE", answer_in_words(response))
    kit.support.settable[name] = False
    raise Skipped(f"it can be got, not set: {answer_in_words(response)}")


def _require_other_unit(kit: Taking, name: str, value: float, unit: str) -> None:
    """Back to the first value, given in another unit."""
    other = _SMALLER[unit]
    text = f"{convert(value, unit, other):.12g}"
    response = kit.bench.set(name, text, other)
    expect(response.ok, f"REP_SUCCESS to {name} = {text} {other}", answer_in_words(response))
    kit.bench.settled(kit.bench.story.mark())
    _require_told(name, kit.bench.get(name), value, unit, f"what is got after setting {text} {other}")
    _require_told(name, kit.bench.get(name, other), value, unit, f"what is got in {other}")


def _require_told(name: str, told: Parameter, wanted: float, unit: str, where: str) -> None:
    came = number(told, unit) if unit else number(told)
    alike = near(came, wanted, absolute=1e-12 if unit == "m" else 1e-6 if unit == "deg" else 0.0)
    expect(alike, f"{name} = {wanted:.6g} {unit}".rstrip() + f" as {where}", f"{told.value} {told.unit or ''}".rstrip())


def _written(value: float, name: str) -> str:
    """As a person would write it; pixels are whole numbers."""
    return str(round(value)) if name in (names.SCAN_RESOLUTION_X, names.SCAN_RESOLUTION_Y) else f"{value:.6g}"


def _require_refused(kit: Taking, name: str) -> None:
    bench = kit.bench
    bench.come_to_rest()
    before = bench.get(name)
    for value in _NO_VALUES:
        require_param_error(kit, name, value, before.unit, before)
    require_param_error(kit, name, str(before.value), _BAD_UNIT, before)


def require_param_error(kit: Taking, name: str, value: str, unit: str | None, before: Parameter) -> None:
    """Setting that is refused with REP_PARAM_ERROR, and changes nothing."""
    asked = f"{name} = {value!r} {unit or ''}".rstrip()
    response = kit.bench.ask_directly(ControlRequest.PARAM, Parameter(name, value, unit))
    expect(response.code == ControlResponse.PARAM_ERROR, f"REP_PARAM_ERROR to {asked}", answer_in_words(response))
    after = kit.bench.get(name)
    expect(
        after.value == before.value, f"{name} unchanged, {before.value}, after {asked} was refused", f"{after.value}"
    )
