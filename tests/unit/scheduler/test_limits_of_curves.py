"""The ends of a curve's sweep are values: they are judged when they are set, and as they are before each curve."""

from __future__ import annotations

import pytest
from tests.unit.scheduler.core_parts import Held

from afspm.model import ControlRequest, Parameter, Request, names
from afspm.scheduler.safety.forbidden_states import PresentState
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState, Limit

BIAS = Limit(-3.0, 3.0, unit="V", source="e.toml:4")
CURVE = Request(int(ControlRequest.ACTION), names.START_SPEC, id="curve")


def guard(**limits: Limit) -> Held[LimitChecker]:
    return Held(LimitChecker(ExperimentLimits({name.replace("_", "-"): one for name, one in limits.items()})))


def setting(name: str, value: str, unit: str | None = "V") -> Request:
    return Request(int(ControlRequest.PARAM), Parameter(name, value, unit), id="i")


def refused(held: Held[LimitChecker], kind: str | None, **shown: str) -> str:
    """Return why a curve is refused after the microscope has shown these values in SI; empty if it may begin."""
    needed = held.depends_on(CURVE)
    units = {**names.OF_CURVES, names.TIP_BIAS_VOLTAGE: "V"}
    read = {name.replace("_", "-"): value for name, value in shown.items()}
    values = {name: Parameter(name, read[name], units.get(name)) for name in needed if name in read}
    if kind is not None and names.SPEC_KIND in needed:
        values[names.SPEC_KIND] = Parameter(names.SPEC_KIND, kind)
    held.was_read(values, 0)
    refusal = held.check_place(CURVE)
    return "" if refusal is None else refusal.reason


# spectra F10, whoever set the range
@pytest.mark.parametrize(("first", "last", "may"), [("-3", "3", True), ("-3", "10", False), ("-3.1", "0", False)])
def test_curve_beyond_the_limit_of_the_bias_is_refused(first: str, last: str, *, may: bool) -> None:
    why = refused(guard(tip_bias_voltage=BIAS), "IV", x_spec_from=first, x_spec_to=last)
    assert (why == "") is may
    assert may or ("allowed, " in why and "3 V (e.toml:4)" in why)


@pytest.mark.parametrize(("value", "unit", "may"), [("2.9", "V", True), ("2900", "mV", True), ("3100", "mV", False)])
@pytest.mark.parametrize("name", names.SPEC_ENDS)
def test_end_of_a_sweep_is_judged_by_the_bias_when_it_is_set(name: str, value: str, unit: str, *, may: bool) -> None:
    assert (guard(tip_bias_voltage=BIAS).check("survey", setting(name, value, unit), 0) is None) is may


def test_the_narrower_of_two_limits_holds() -> None:
    narrow = Limit(-1.0, 1.0, unit="V", source="e.toml:9")
    for wide_or_narrow in ({"tip_bias_voltage": BIAS, "x_spec_to": narrow}, {"tip_bias_voltage": narrow}):
        assert "e.toml:9" in refused(guard(**wide_or_narrow), "IV", x_spec_from="0", x_spec_to="2")


def test_curve_of_the_height_is_judged_by_the_height_alone() -> None:
    near = Limit(-2e-9, None, unit="m", source="e.toml:7")
    both = {"tip_bias_voltage": BIAS, "x_spec_z_to": near}
    shown = {"x_spec_from": "-10", "x_spec_to": "10", "x_spec_z_from": "2e-8"}
    assert refused(guard(**both), "force", **shown, x_spec_z_to="-1e-9") == ""
    assert "x-spec-z-to = -3 nm is below" in refused(guard(**both), "force", **shown, x_spec_z_to="-3e-9")
    assert refused(guard(x_spec_z_to=near), "IV", **shown, x_spec_z_to="-3e-9") == ""


@pytest.mark.parametrize("kind", ["IV", "GVP", None])
def test_curve_whose_range_is_not_shown_needs_a_word(kind: str | None) -> None:
    why = refused(guard(tip_bias_voltage=BIAS), kind)
    assert "does not show how far" in why
    assert "unseen_sweeps = true" in why
    allowed = Limit(-3.0, 3.0, unit="V", unseen_sweeps=True)
    assert refused(guard(tip_bias_voltage=allowed), kind) == ""


def test_ends_of_a_vector_program_are_not_those_of_the_table() -> None:
    assert "does not show" in refused(guard(tip_bias_voltage=BIAS), "GVP", x_spec_from="-1", x_spec_to="1")


@pytest.mark.parametrize("limits", [{}, {"tip_bias_voltage": Limit(step=0.5, unit="V")}, {"zctrl_setpoint": BIAS}])
def test_nothing_is_read_without_a_range_that_a_curve_could_break(limits: dict[str, Limit]) -> None:
    assert not {names.SPEC_KIND, *names.SPEC_ENDS} & set(guard(**limits).depends_on(CURVE))
    assert refused(guard(**limits), "IV") == ""


@pytest.mark.parametrize(("last", "kind", "may"), [("0.9", "IV", True), ("1.1", "IV", False), ("1.1", "force", True)])
def test_both_ends_of_a_sweep_are_judged_by_rules(last: str, kind: str, *, may: bool) -> None:
    rule = ForbiddenState("abs(tip-bias-voltage) > 1 V and x-feedback-on", {names.TIP_BIAS_VOLTAGE: "V"})
    held = Held(LimitChecker(ExperimentLimits(forbid={"rule": rule})))
    assert set(names.SPEC_ENDS) <= set(held.depends_on(CURVE))
    assert refused(held, kind, x_spec_from="-0.5", x_spec_to=last) == ""
    present = PresentState({
        names.TIP_BIAS_VOLTAGE: (Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"),),
        names.FEEDBACK_ON: (Parameter(names.FEEDBACK_ON, "true"),),
    })  # fmt: skip
    assert (held.check_forbidden(CURVE, present) is None) is may


def test_height_and_modulation_of_a_curve_are_judged_too() -> None:
    low, loud = Limit(-1e-9, None, unit="m"), Limit(None, 0.05, unit="V")
    usual = {"x_spec_z_offset": "0", "x_lock_in_amplitude": "0.01"}
    for limits in ({"x_spec_z_offset": low, "x_lock_in_amplitude": loud}, {"x_spec_z_from": low}):
        assert refused(guard(**limits), "IV", **usual) == ""
        assert "-2 nm is below" in refused(guard(**limits), "IV", **usual | {"x_spec_z_offset": "-2e-9"})
    assert "9 V is above" in refused(guard(x_lock_in_amplitude=loud), "IV", x_lock_in_amplitude="9")
    assert guard(x_spec_z_to=low).check("survey", setting("x-spec-z-offset", "-2", "nm"), 0) is not None


def test_values_that_are_no_longer_shown_are_unknown() -> None:
    held = guard(tip_bias_voltage=BIAS)
    assert refused(held, "IV", x_spec_from="-1", x_spec_to="1") == ""
    assert "does not show how far" in refused(held, "IV")
    assert refused(held, "force", x_spec_from="-9", x_spec_to="9") == ""
    assert "x-spec-from" in refused(held, None, x_spec_from="-9", x_spec_to="9")


def test_each_limit_on_an_end_must_allow_an_unseen_sweep() -> None:
    own = Limit(-3.0, 3.0, unit="V", unseen_sweeps=True)
    ends = {name.replace("-", "_"): own for name in names.SPEC_ENDS}
    assert "does not show how far" in refused(guard(tip_bias_voltage=BIAS, **ends), "IV")
    assert refused(guard(**ends), "IV") == ""
