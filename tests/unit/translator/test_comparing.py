"""What a measurement states is compared by the translator, claimed, and in force at its begin, or it does not begin."""

from __future__ import annotations

from typing import Any

import pytest

from afspm import wire
from afspm.model import (
    ControlRequest,
    ControlResponse,
    MeasurementConditions,
    Parameter,
    Response,
    ResponseDetail,
    ScopeState,
    names,
)
from afspm.model.requests import COMPARE_REQUEST, Setting, Settings

OK = ControlResponse.SUCCESS
ACTION, PARAM = ControlRequest.ACTION, ControlRequest.PARAM
BIAS = names.TIP_BIAS_VOLTAGE


def volts(value: str) -> Parameter:
    return Parameter(BIAS, value, "V")


def compared(bench: Any, *settings: Setting) -> dict[str, Setting]:
    response: Response = bench.ask(COMPARE_REQUEST, Settings(settings))
    assert response.code == OK
    found: Settings = wire.decode("LentSettings", response.payload)
    return {one.parameter.name: one for one in found.settings}


def claimed(value: str, *known: str) -> Setting:
    return Setting(Parameter(BIAS, None, "V"), tuple(map(volts, (value, *known))), is_claimed=True)


def begin_values(bench: Any, scan: Any) -> list[tuple[str, str | None]]:
    """Finish the running scan, and return the settings that it stands for."""
    bench.microscope.files["scan"] = [scan()]
    bench.microscope.state = ScopeState.FREE
    bench.look()
    bench.heard()
    (found,) = [one for one in bench.beside if isinstance(one, MeasurementConditions)]
    return [(one.name, one.value) for one in found.begin_values]


def test_values_that_a_controller_can_not_tell_apart_are_in_force(make_bench: Any) -> None:
    bench = make_bench({"parameters": {BIAS: {"resolution": "2 mV"}}})
    bench.microscope.values["Bias"] = 100.6
    known = (volts("0.1"), volts("0.2"), Parameter(BIAS, "101", "mV"))
    found = compared(bench, Setting(Parameter(BIAS, None, "V"), known))
    assert found[BIAS].known == (volts("0.1"), Parameter(BIAS, "101", "mV"))
    assert found[BIAS].parameter == volts("0.1006")
    assert found[BIAS].is_lent


def test_value_of_a_sweep_finer_than_the_resolution_is_not_in_force_yet(make_bench: Any) -> None:
    bench = make_bench({"parameters": {BIAS: {"resolution": "2 mV"}}})
    assert bench.ask(PARAM, volts("0.1")).code == OK
    assert compared(bench, claimed("0.101", "0.1"))[BIAS].known == (volts("0.1"),)
    assert compared(bench, claimed("0.1"))[BIAS].known == (volts("0.1"),)


def test_row_of_a_user_may_be_lent_where_its_table_says_so(make_bench: Any) -> None:
    rows = {name: {"vendor": "Bias", "unit": "V", **more} for name, more in (("x-a", {"lent": True}), ("x-b", {}))}
    found = compared(make_bench({"parameters": rows}), *(Setting(Parameter(name)) for name in rows))
    assert [one.is_lent for one in found.values()] == [True, False]


def test_parameter_that_the_microscope_lacks_is_left_out(make_bench: Any) -> None:
    assert compared(make_bench({}), Setting(Parameter("x-nothing"))) == {}


def test_value_that_is_in_force_already_is_claimed(make_bench: Any, scan: Any) -> None:
    bench = make_bench({})
    compared(bench, claimed("0.1"))
    bench.heard()
    assert bench.ask(ACTION, names.START_SCAN, "a/1/1").code == OK
    assert begin_values(bench, scan) == [(BIAS, "0.1")]


def test_measurement_whose_setting_was_changed_does_not_begin_and_begins_when_it_is_stated_again(
    make_bench: Any, scan: Any
) -> None:
    bench = make_bench({})
    compared(bench, claimed("0.1"))
    bench.microscope.values["Bias"] = 700.0
    refusal = bench.ask(ACTION, names.START_SCAN, "a/1/1")
    assert (refusal.code, refusal.detail) == (ControlResponse.NOT_FREE, ResponseDetail.STATE_AGAIN)
    assert "tip-bias-voltage was 700 mV at its begin, and the run had set it to 100 mV" in refusal.reason
    compared(bench, claimed("0.7"))
    assert bench.ask(ACTION, names.START_SCAN, "a/1/2").code == OK
    assert begin_values(bench, scan) == [(BIAS, "0.7")]


def test_measurement_that_states_nothing_is_refused_once_at_most(make_bench: Any) -> None:
    bench = make_bench({})
    compared(bench, claimed("0.1"))
    bench.microscope.values["Bias"] = 700.0
    assert bench.ask(ACTION, names.START_SCAN, "b/1/1").detail is ResponseDetail.STATE_AGAIN
    assert bench.ask(ACTION, names.START_SCAN, "b/1/2").code == OK


@pytest.mark.parametrize("is_compared", [True, False])
def test_claim_of_another_component_ends_when_its_value_is_compared(
    make_bench: Any, scan: Any, *, is_compared: bool
) -> None:
    bench = make_bench({})
    compared(bench, claimed("0.1"))
    if is_compared:
        compared(bench, Setting(Parameter(BIAS, None, "V"), (volts("0.1"),)))
    bench.heard()
    assert bench.ask(ACTION, names.START_SCAN, "b/1/1").code == OK
    assert begin_values(bench, scan) == ([] if is_compared else [(BIAS, "0.1")])


def test_comparing_disturbs_no_running_measurement(make_bench: Any, scan: Any) -> None:
    bench = make_bench({})
    bench.heard()
    assert bench.ask(ACTION, names.START_SCAN, "a/1/1").code == OK
    assert compared(bench, Setting(Parameter(BIAS, None, "V"), (volts("0.1"),)))[BIAS].known
    assert begin_values(bench, scan) == []
