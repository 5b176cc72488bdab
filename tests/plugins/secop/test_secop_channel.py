"""A parameter at a SECoP server: its description, and the start of steps to a new target."""

from __future__ import annotations

import math

import pytest

from afspm.plugins.secop.channel import Approach, Channel, ModuleState, PolledValue, ReportedTarget, described
from afspm.plugins.secop.lines import SecopLine

NEAR_K = 0.1


def _modules(**more: object) -> dict[str, object]:
    value = {"datainfo": {"type": "double", "unit": "K"}}
    target = {"readonly": False, "datainfo": {"type": "double", "unit": "K", "min": 0.0, "max": 300.0}}
    return {"tt": {"accessibles": {"value": value, "target": target, **more}}}


def _ramp(unit: str) -> dict[str, object]:
    return {"readonly": False, "datainfo": {"type": "double", "unit": unit, "max": 6.0}}


def test_description_has_the_range_of_the_target_and_no_ramp() -> None:
    found = described(_modules(), "tt", "")
    assert (found.value, found.target, found.status, found.unit) == ("tt:value", "tt:target", "", "K")
    assert (found.low, found.high, found.ramp) == (0.0, 300.0, None)


def test_rate_is_sent_in_the_unit_of_the_servers_ramp() -> None:
    ramp = described(_modules(ramp=_ramp("K/min")), "tt", "").ramp
    assert ramp is not None
    assert ramp.limit(0.05) == pytest.approx(3.0)
    assert ramp.limit(1.0) == 6.0


@pytest.mark.parametrize(
    ("more", "has_ramp"),
    [
        ({"ramp": _ramp("K/h")}, True),
        ({"ramp": _ramp("V")}, False),
        ({"ramp": _ramp("K/h"), "use_ramp": {"readonly": True, "datainfo": {"type": "bool"}}}, False),
        ({"ramp": _ramp("K/h"), "use_ramp": {"readonly": True, "constant": True, "datainfo": {"type": "bool"}}}, True),
    ],
)
def test_ramp_counts_only_if_it_is_certainly_on(more: dict[str, object], has_ramp: bool) -> None:
    assert (described(_modules(**more), "tt", "").ramp is not None) is has_ramp


@pytest.mark.parametrize(
    ("target", "state", "approach", "start"),
    [
        (None, ModuleState(), Approach(), 4.0),
        (4.05, ModuleState(), Approach(), 4.05),
        (9.0, ModuleState(), Approach(), 4.0),
        (4.05, ModuleState(is_controlled=False), Approach(), 4.0),
        (4.5, ModuleState(), Approach(4.5, nearest=0.45, is_led=True), 4.5),
        (9.0, ModuleState(is_busy=True), Approach(9.0, nearest=0.05), 9.0),
        (9.0, ModuleState(is_busy=True), Approach(9.0, nearest=4.0), 4.0),
    ],
    ids=[
        "unknown",
        "reached",
        "far",
        "switched off",
        "lagging behind steps",
        "disturbed",
        "on the way of another client",
    ],
)
def test_steps_begin_at_the_target_only_if_it_is_in_force(
    target: float | None, state: ModuleState, approach: Approach, start: float
) -> None:
    channel = Channel("cryo.t", "tt", "", value=PolledValue(4.0), target=ReportedTarget(target), state=state)
    channel.approach = approach
    assert channel.start_of_steps(NEAR_K) == start


def test_new_target_forgets_that_afspm_led_the_value_to_the_former() -> None:
    approach = Approach()
    approach.note(4.2, 4.0)
    approach.is_led = True
    approach.note(4.3, 4.0)
    assert (approach.nearest, approach.is_led) == (pytest.approx(0.2), True)
    approach.note(4.3, 9.0)
    assert (approach.nearest, approach.is_led) == (pytest.approx(4.7), False)
    assert math.isnan(Approach().target)


@pytest.mark.parametrize(
    ("state", "value_k", "measured_s", "now_s", "is_on_its_way"),
    [
        (ModuleState(), 20.0, 10.1, 10.2, True),
        (ModuleState(answered_s=10.1), 19.9, 10.1, 10.2, False),
        (ModuleState(answered_s=10.1), 4.2, 10.1, 10.2, True),
        (ModuleState(answered_s=10.1), 19.9, 9.9, 10.2, True),
        (ModuleState(answered_s=10.1), 4.2, 10.1, 13.1, False),
        (ModuleState(answered_s=10.9, busy_s=10.5), 18.0, 10.9, 11.0, False),
        (ModuleState(is_busy=True, answered_s=99.0, busy_s=99.0), 20.0, 99.0, 99.0, True),
    ],
    ids=["status unknown", "arrived", "idle too early", "old value", "idle for 3 s", "was busy", "busy"],
)
def test_idle_module_is_believed_unless_its_value_is_away_from_a_new_target(
    state: ModuleState, value_k: float, measured_s: float, now_s: float, is_on_its_way: bool
) -> None:
    channel = Channel("cryo.t", "tt", "", value=PolledValue(value_k, measured_s=measured_s), state=state)
    channel.described = described(_modules(status={}), "tt", "")
    channel.target.take(SecopLine("changed", "tt:target", [20.0, {}]), 4.2, 10.0)
    assert channel.is_on_its_way(now_s) is is_on_its_way
