"""Checks of the z feedback: gains, setpoint, on and off."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from afspm.model import ControlRequest, ControlResponse, Feedback, names
from afspm.testing.conformance import Failed, Skipped, expect, near
from afspm.testing.translators.client import answer_in_words, describe_all
from afspm.testing.translators.measuring import CheckMeasurements, number
from afspm.testing.translators.translator_suite import check

_NUMBERS = {
    "proportional_gain": names.ZCTRL_PGAIN,
    "integral_gain": names.ZCTRL_IGAIN,
    "setpoint": names.ZCTRL_SETPOINT,
}
_STEP = 1.02
"""A relative change that is harmless even for an engaged tip."""


def in_force(kit: CheckMeasurements) -> Feedback:
    """Return the last published feedback."""
    feedback = kit.client.observations.newest(Feedback)
    if feedback is None and not any(map(kit.support.has, _NUMBERS.values())):
        raise Skipped("the microscope reports no feedback")
    if feedback is None:
        raise Failed("ZCtrlParameters at the start", describe_all(kit.client.observations.all[:10]))
    return feedback


def set_and_require(kit: CheckMeasurements, wanted: Feedback) -> None:
    """Set the given fields, and raise Failed unless exactly these fields change, published once.

    Raises:
        Skipped: the microscope refused the values, and changed nothing.
    """
    kit.client.come_to_rest()
    before, mark = in_force(kit), kit.client.observations.mark()
    given = {name: value for name, value in vars(wanted).items() if value is not None}
    response = kit.client.ask(ControlRequest.SET_ZCTRL_PARAMS, wanted)
    observed = kit.client.settled(mark, awaiting=Feedback if response.ok else None)
    if response.code in (ControlResponse.PARAM_ERROR, ControlResponse.PARAM_NOT_SUPPORTED):
        require_same(before, in_force(kit))
        raise Skipped(f"it can't be set here: {answer_in_words(response)}")
    expect(response.ok, f"REP_SUCCESS to setting {', '.join(given)} of the feedback", answer_in_words(response))
    after = in_force(kit)
    count = sum(isinstance(one.thing, Feedback) for one in observed)
    expect(count == 1, "the new ZCtrlParameters once", describe_all(observed))
    require_same(replace(before, **given), after)


def require_same(wanted: Feedback, came: Feedback) -> None:
    """Raise Failed unless both agree within the tolerance of `near`."""
    for name, value in vars(wanted).items():
        other = getattr(came, name)
        if value is None or other is None or isinstance(value, bool):
            expect(value == other, f"ZCtrlParameters with {name} = {value}", f"{other}")
        else:
            expect(near(value, other), f"ZCtrlParameters with {name} = {value:.6g}", f"{other:.6g}")


def _stepped(kit: CheckMeasurements, fields: Iterable[str]) -> Feedback:
    now = in_force(kit)
    values = {name: getattr(now, name) for name in fields if kit.support.has(_NUMBERS[name])}
    values = {name: value * _STEP for name, value in values.items() if value}
    if not values:
        raise Skipped("they are not supported, or are 0 and can't be changed by a fraction")
    return Feedback(**values)


@check("feedback/numbers", "gains and setpoint are set and published")
def numbers(kit: CheckMeasurements) -> None:
    set_and_require(kit, _stepped(kit, _NUMBERS))


@check("feedback/one", "only the fields that are present are set: the integral gain", needs=(names.ZCTRL_IGAIN,))
def one(kit: CheckMeasurements) -> None:
    set_and_require(kit, _stepped(kit, ["integral_gain"]))


@check("feedback/as-parameters", "the parameters report what was set of the feedback")
def as_parameters(kit: CheckMeasurements) -> None:
    wanted = _stepped(kit, _NUMBERS)
    set_and_require(kit, wanted)
    for field, name in _NUMBERS.items():
        value = getattr(wanted, field)
        if value is not None:
            came = number(kit.client.get(name))
            expect(near(came, value), f"{name} = {value:.6g}", f"{came:.6g}")


@check("feedback/on-off", "the feedback is switched off and on, and published")
def on_off(kit: CheckMeasurements) -> None:
    before = in_force(kit).on
    kit.support.settable[names.FEEDBACK_ON] = False
    if before is None:
        raise Skipped("the microscope does not report whether its feedback is on")
    for on in (not before, before):
        set_and_require(kit, Feedback(on=on))
        if kit.support.has(names.FEEDBACK_ON):
            value = str(kit.client.get(names.FEEDBACK_ON).value).lower()
            expect(value == str(on).lower(), f"{names.FEEDBACK_ON} = {str(on).lower()}", value)
            kit.support.settable[names.FEEDBACK_ON] = True
