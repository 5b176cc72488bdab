"""Limits: which requests are refused, and with which reasons."""

from __future__ import annotations

import json
import math

import pytest
from tests.unit.scheduler.core_parts import Held

from afspm import wire
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Feedback,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    Request,
    ScanParameters,
    names,
)
from afspm.model.scan import ShapeChange
from afspm.model.snapshot import from_plain, to_plain
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.limits import ExperimentLimits, Limit

NS = 10**9
BIAS = "tip-bias-voltage"
STAGE = Region((0.0, 0.0), (10e-6, 10e-6))


def checker(limits: ExperimentLimits | None = None) -> Held[LimitChecker]:
    return Held(LimitChecker(limits or ExperimentLimits()))


def guard(**parameters: Limit) -> Held[LimitChecker]:
    return checker(ExperimentLimits({name.replace("_", "-"): limit for name, limit in parameters.items()}))


def set_(value: str, unit: str | None = None, name: str = BIAS) -> Request:
    return Request(int(ControlRequest.PARAM), Parameter(name, value, unit), id="i")


def scan(region: Region | RegionChange | None = None, shape: tuple[int, int] | ShapeChange | None = None) -> Request:
    return Request(int(ControlRequest.SET_SCAN_PARAMS), ScanParameters(region, shape))


def probe(x: float, y: float) -> Request:
    return Request(int(ControlRequest.SET_PROBE_POS), ProbePosition((x, y)))


def why(guard: Held[LimitChecker], request: Request, who: str = "experiment", now_ns: int = 0) -> str:
    """Return the reason of the refusal; empty if there is none."""
    refusal = guard.check(who, request, now_ns)
    if refusal is None:
        return ""
    assert refusal.code in (ControlResponse.PARAM_ERROR, ControlResponse.ACTION_ERROR)
    assert refusal.id == request.id
    return str(refusal.reason)


def test_a_refusal_names_parameter_value_limit_and_where_it_was_set() -> None:
    reason = why(guard(tip_bias_voltage=Limit(-5.0, 5.0, source="experiment.toml:42")), set_("7.5", "V"))
    for part in (BIAS, "7.5", "5 V", "experiment.toml:42"):
        assert part in reason


def test_refusals_have_readable_units() -> None:
    near = checker(ExperimentLimits(region=STAGE))
    corner = ScanParameters(Region((4.5e-6, 0.0), (4e-6, 1e-6)))
    assert "the scan's corner (6.5, -0.5) µm" in why(near, Request(int(ControlRequest.SET_SCAN_PARAMS), corner))
    empty = Request(int(ControlRequest.SET_SCAN_PARAMS), ScanParameters(RegionChange(width_m=-2e-9)))
    assert "size -2 nm" in why(near, empty)
    steps = guard(tip_bias_voltage=Limit(step=2e-3))
    steps.in_force(Parameter(BIAS, "0.1", "V"), 0)
    assert "= 107.5 mV is a step of 7.5 mV, the largest allowed is 2 mV" in why(steps, set_("0.1075", "V"))


@pytest.mark.parametrize(
    ("value", "unit", "fits"), [("5", "V", True), ("5000", "mV", True), ("5001", "mV", False), ("-5.1", None, False)]
)
def test_a_range_is_checked_in_any_unit(value: str, unit: str | None, fits: bool) -> None:
    assert (why(guard(tip_bias_voltage=Limit(-5.0, 5.0)), set_(value, unit)) == "") is fits


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "NaN", "abc", "", "0x10"])
def test_base_parameters_are_finite_numbers_with_or_without_a_limit(value: str) -> None:
    assert why(checker(), set_(value, "V"))


def test_a_unit_of_the_wrong_kind_is_refused() -> None:
    assert why(checker(), set_("1", "nm"))


def test_custom_parameter_may_be_text_unless_limited() -> None:
    assert not why(checker(), set_("fast", None, "x-mode"))
    assert why(guard(x_mode=Limit(0.0, 1.0)), set_("fast", None, "x-mode"))


def test_getting_is_never_limited() -> None:
    request = Request(int(ControlRequest.PARAM), Parameter(BIAS))
    assert not why(guard(tip_bias_voltage=Limit(only=("nobody",))), request)


def test_step_is_measured_from_the_value_in_force() -> None:
    g = guard(tip_bias_voltage=Limit(step=0.5))
    assert "reports no value now" in why(g, set_("0.1", "V"))
    g.carried_out(Request(int(ControlRequest.PARAM), Parameter(BIAS)), 0, Parameter(BIAS, "1000", "mV"))
    assert not why(g, set_("1.5", "V"))
    assert "step" in why(g, set_("1.6", "V"))
    g.carried_out(set_("1.5", "V"), NS)
    assert not why(g, set_("2.0", "V"))


def test_step_is_not_measured_from_a_refused_value() -> None:
    g = guard(tip_bias_voltage=Limit(step=0.5))
    g.carried_out(set_("1", "V"), 0)
    for _ in range(5):
        assert why(g, set_("3", "V"))


def test_a_rate_allows_more_with_time() -> None:
    g = guard(tip_bias_voltage=Limit(rate_per_s=0.1))
    g.carried_out(set_("0", "V"), 0)
    assert "per second" in why(g, set_("1", "V"), now_ns=5 * NS)
    assert not why(g, set_("1", "V"), now_ns=10 * NS)


def test_an_interval_lies_between_two_uses() -> None:
    g = checker(ExperimentLimits(actions={"x-pulse": Limit(interval_s=60.0, source="toml:3")}))
    pulse = Request(int(ControlRequest.ACTION), "x-pulse")
    assert not why(g, pulse)
    g.carried_out(pulse, 0)
    assert "toml:3" in why(g, pulse, now_ns=59 * NS)
    assert not why(g, pulse, now_ns=60 * NS)


def test_only_named_components_may_set_a_parameter() -> None:
    g = checker(ExperimentLimits({BIAS: Limit(only=("corrector",))}, {"x-crash": Limit(only=("corrector",))}))
    crash = Request(int(ControlRequest.ACTION), "x-crash")
    for request in (crash, set_("1", "V")):
        assert "corrector" in why(g, request, "experiment")
        assert not why(g, request, "corrector")


def test_the_fields_of_messages_are_limited_like_the_parameters_of_their_names() -> None:
    g = guard(
        zctrl_setpoint=Limit(0.0, 1.0),
        scan_size_x=Limit(high=5e-6),
        scan_resolution_x=Limit(high=512),
        probe_pos_x=Limit(high=1e-6),
    )
    feedback = Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(setpoint=2.0))
    assert "zctrl-setpoint" in why(g, feedback)
    assert not why(g, Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(on=False, integral_gain=9.0)))
    assert "scan-size-x" in why(g, scan(Region((0, 0), (6e-6, 1e-6))))
    assert "scan-resolution-x" in why(g, scan(shape=(10, 513)))
    assert "probe-pos-x" in why(g, probe(2e-6, 0.0))


def test_scans_stay_in_the_region_with_all_their_corners() -> None:
    g = checker(ExperimentLimits(region=STAGE, region_source="toml:9"))
    assert not why(g, scan(Region((0, 0), (10e-6, 10e-6))))
    assert "toml:9" in why(g, scan(Region((0, 0), (9e-6, 9e-6), math.pi / 4)))
    assert why(g, scan(Region((4e-6, 0), (3e-6, 1e-6))))
    assert not why(g, scan(Region((0, 0), (6e-6, 6e-6), math.pi / 4)))


def test_a_turned_region_is_respected() -> None:
    g = checker(ExperimentLimits(region=Region((0, 0), (10e-6, 2e-6), math.pi / 2)))
    assert not why(g, probe(0.5e-6, 4.5e-6))
    assert why(g, probe(4.5e-6, 0.5e-6))


def test_the_probe_stays_in_the_region_and_goes_to_real_places() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    assert not why(g, probe(5e-6, -5e-6))
    assert why(g, probe(5.1e-6, 0.0))
    assert why(g, probe(math.nan, 0.0))


def test_a_scan_moved_by_single_parameters_stays_in_the_region_too() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    move = set_("4", "um", "scan-top-left-x")
    assert "not reported" in why(g, move)
    g.in_force(ScanParameters(Region((0, 0), (2e-6, 2e-6)), (64, 64)), 0)
    assert why(g, move)
    assert not why(g, set_("3", "um", "scan-top-left-x"))
    assert why(g, set_("90", "deg", "scan-angle")) == ""
    assert why(g, set_("20", "um", "scan-size-y"))


def test_a_part_of_a_region_is_checked_with_the_rest_of_it() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    assert "not reported" in why(g, scan(RegionChange(left_m=0.0)))
    g.in_force(ScanParameters(Region((0, 0), (2e-6, 2e-6)), (64, 64)), 0)
    assert not why(g, scan(RegionChange(left_m=3e-6)))
    assert why(g, scan(RegionChange(left_m=3.5e-6)))


@pytest.mark.parametrize("size", [0.0, -1e-6, math.nan, math.inf])
def test_a_scan_of_no_size_is_refused(size: float) -> None:
    assert why(checker(), scan(RegionChange(width_m=size)))
    assert why(checker(), set_(str(size), "m", "scan-size-x"))


def test_absurd_numbers_of_pixels_are_refused() -> None:
    assert why(checker(), scan(shape=(10**5, 10**4)))
    g = checker()
    g.in_force(ScanParameters(shape=(10**5, 10)), 0)
    assert why(g, set_("10000", None, "scan-resolution-x"))
    for value in ("0", "-4", "1.5"):
        assert why(g, set_(value, None, "scan-resolution-x"))


def test_a_part_of_a_position_is_checked_with_the_rest_of_it() -> None:
    limits = checker(ExperimentLimits(region=STAGE))
    half = Request(int(ControlRequest.SET_PROBE_POS), PositionChange(x_m=4e-6))
    assert "not reported" in why(limits, half)
    limits.in_force(ProbePosition((0.0, 4.9e-6)), 0)
    assert why(limits, half) == ""
    limits.carried_out(half, 0)
    beyond = Request(int(ControlRequest.SET_PROBE_POS), PositionChange(y_m=5.1e-6))
    assert "(4, 5.1) µm" in why(limits, beyond)


def test_pixels_along_one_axis_are_counted_with_those_along_the_other() -> None:
    limits = checker(ExperimentLimits(most_pixels=1000, most_pixels_source="toml:7"))
    limits.in_force(ScanParameters(STAGE, (100, 5)), 0)
    assert why(limits, scan(shape=ShapeChange(columns=10))) == ""
    refusal = "11 x 100 pixels is above the highest number allowed, 1000 pixels (toml:7): choose fewer"
    assert refusal in why(limits, scan(shape=ShapeChange(columns=11)))


def test_an_angle_without_a_unit_is_in_degrees() -> None:
    g = guard(scan_angle=Limit(-math.pi / 2, math.pi / 2))
    assert not why(g, set_("89", None, "scan-angle"))
    assert why(g, set_("91", None, "scan-angle"))


def act(action: str, id_: str = "") -> Request:
    return Request(int(ControlRequest.ACTION), action, id=id_)


def here(guard: Held[LimitChecker], action: str) -> str:
    """Return the reason of a refusal at the present place of the scan or probe; empty if there is none."""
    refusal = guard.check_place(act(action))
    if refusal is None:
        return ""
    assert refusal.code == ControlResponse.ACTION_ERROR
    return str(refusal.reason)


def restarted(limits: ExperimentLimits, before: Held[LimitChecker]) -> Held[LimitChecker]:
    plain = json.loads(json.dumps(to_plain(before.state)))
    return Held(LimitChecker(limits, from_plain(LimitState, plain)))


def test_scan_outside_the_region_is_refused_even_if_set_at_the_panel() -> None:
    g = checker(ExperimentLimits(region=STAGE, region_source="toml:9"))
    assert "not reported" in here(g, "start-scan")
    g.in_force(ScanParameters(Region((4.9e-6, 0), (1e-6, 1e-6)), (8, 8)), 0)
    assert "toml:9" in here(g, "start-scan")
    assert here(g, "stop-scan") == here(g, "x-retract") == ""
    g.in_force(ScanParameters(Region((4e-6, 0), (1e-6, 1e-6)), (8, 8)), 0)
    assert here(g, "start-scan") == ""
    assert here(checker(), "start-scan") == ""


@pytest.mark.parametrize("action", ["start-scan", "start-spec", "x-pulse", "x-crash"])
def test_measurement_with_a_bias_beyond_its_range_is_refused_though_no_request_has_set_it(action: str) -> None:
    g = guard(tip_bias_voltage=Limit(-2.0, 2.0, source="toml:9"))
    assert names.TIP_BIAS_VOLTAGE in g.depends_on(act(action))
    assert g.depends_on(act("stop-scan")) == g.depends_on(act("x-retract")) == []
    for bias, refused in (("8", True), ("2", False)):
        read = (Parameter(names.TIP_BIAS_VOLTAGE, bias, "V"), Parameter(names.SPEC_KIND, "force"))
        g.was_read({one.name: one for one in read}, 0)
        assert ("toml:9" in here(g, action)) is refused
        assert here(g, "stop-scan") == here(g, "x-retract") == ""


@pytest.mark.parametrize("action", ["start-spec", "x-pulse", "x-crash"])
def test_action_at_the_probe_outside_the_region_is_refused_even_if_moved_at_the_panel(action: str) -> None:
    g = checker(ExperimentLimits(region=STAGE, region_source="toml:9"))
    assert "not reported" in here(g, action)
    g.in_force(ProbePosition((9e-6, 0.0)), 0)
    assert "(9, 0) µm" in here(g, action)
    assert "toml:9" in here(g, action)
    g.in_force(ProbePosition((5e-6, 0.0)), 0)
    assert here(g, action) == ""


def test_frame_up_to_the_border_may_be_rounded_by_the_controller() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    assert why(g, scan(Region((4.5e-6, 0.0), (1.0000002e-6, 1e-6))))
    g.in_force(ScanParameters(Region((4.5e-6, 0.0), (1.0000002e-6, 1e-6)), (8, 8)), 0)
    g.in_force(ProbePosition((5.0000002e-6, 0.0)), 0)
    assert here(g, "start-scan") == here(g, "x-pulse") == ""
    g.in_force(ScanParameters(Region((4.5e-6, 0.0), (1.02e-6, 1e-6)), (8, 8)), 0)
    g.in_force(ProbePosition((5.01e-6, 0.0)), 0)
    assert here(g, "start-scan")
    assert here(g, "x-pulse")


def test_a_place_set_by_single_parameters_is_known_before_it_is_published() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    g.in_force(ProbePosition((0.0, 0.0)), 0)
    g.in_force(ScanParameters(Region((0, 0), (1e-6, 1e-6)), (8, 8)), 0)
    g.carried_out(set_("9", "um", "probe-pos-x"), 0)
    g.carried_out(set_("9", "um", "scan-top-left-y"), 0)
    assert here(g, "x-pulse")
    assert here(g, "start-scan")


def test_an_interval_counts_from_the_sending_and_over_a_restart() -> None:
    limits = ExperimentLimits(actions={"x-pulse": Limit(interval_s=60.0)})
    g = checker(limits)
    g.sending("corrector", act("x-pulse", "corrector/1"), 0)
    again = restarted(limits, g)
    assert why(again, act("x-pulse", "corrector/2"), "corrector", 59 * NS)
    assert not why(again, act("x-pulse", "corrector/2"), "corrector", 60 * NS)
    g.carried_out(act("x-pulse", "corrector/1"), NS, who="corrector")
    assert why(restarted(limits, g), act("x-pulse", "corrector/2"), "corrector", 60 * NS)


def test_retry_is_not_too_soon_after_itself() -> None:
    g = checker(ExperimentLimits(actions={"x-pulse": Limit(interval_s=60.0)}))
    g.sending("corrector", act("x-pulse", "corrector/1"), 0)
    assert g.check("corrector", act("x-pulse", "corrector/1"), NS, is_repeated=True) is None
    assert g.check("another", act("x-pulse", "corrector/1"), NS, is_repeated=True)
    assert g.check("corrector", act("x-pulse", "corrector/2"), NS, is_repeated=True)
    assert why(g, act("x-pulse", "corrector/1"), "corrector", NS)  # its first sending is not remembered any more
    assert why(g, act("x-pulse"), "corrector", NS)


def test_request_refused_by_the_microscope_is_no_use() -> None:
    g = checker(ExperimentLimits(actions={"x-pulse": Limit(interval_s=60.0)}))
    g.sending("corrector", act("x-pulse", "corrector/1"), 0)
    g.not_done("corrector", act("x-pulse", "corrector/1"))
    assert not why(g, act("x-pulse", "corrector/2"), "corrector", NS)


def test_only_values_that_limits_are_measured_from_are_saved() -> None:
    g = checker(
        ExperimentLimits(
            {BIAS: Limit(step=0.5), "scan-speed": Limit(high=1.0)}, {"x-crash": Limit(only=("corrector",))}
        )
    )
    fresh = g.state.usage
    g.sending("corrector", act("x-crash"), 0)
    g.carried_out(set_("1e-6", "m/s", "scan-speed"), 0)
    assert g.state.usage == fresh
    g.carried_out(set_("1", "V"), 0)
    known = g.state.usage
    assert known != fresh
    g.carried_out(set_("1", "V"), 0)
    assert g.state.usage == known


def test_steps_rates_and_places_are_known_after_a_restart() -> None:
    limits = ExperimentLimits({BIAS: Limit(step=0.5, rate_per_s=0.1)}, region=STAGE)
    g = checker(limits)
    g.carried_out(set_("1", "V"), 0)
    g.in_force(ScanParameters(Region((4.9e-6, 0), (1e-6, 1e-6), 0.5), (8, 9)), 0)
    g.in_force(ProbePosition((4e-6, 0.0)), 0)
    again = restarted(limits, g)
    assert "step" in why(again, set_("1.6", "V"), now_ns=60 * NS)
    assert "per second" in why(again, set_("1.4", "V"), now_ns=3 * NS)
    assert not why(again, set_("1.4", "V"), now_ns=4 * NS)
    assert here(again, "x-pulse") == ""
    assert "corner" in here(again, "start-scan")
    assert again.state == g.state


def test_setpoint_at_the_limit_is_not_above_it() -> None:
    """The message has 32 bits, in which 0.1 is a little more."""
    limits = guard(zctrl_setpoint=Limit(0.0, 0.1))
    for setpoint, fits in ((0.1, True), (0.100001, False)):
        asked = wire.decode("ZCtrlParameters", wire.encode(Feedback(setpoint=setpoint))[1])
        assert (why(limits, Request(int(ControlRequest.SET_ZCTRL_PARAMS), asked)) == "") is fits


@pytest.mark.parametrize(
    ("name", "value", "unit"),
    [(BIAS, "nan", "V"), (BIAS, "0,5", "V"), (BIAS, "1", "Hz"), ("zctrl-setpoint", "1", "pineapples")],
)
def test_malformed_value_of_a_microscope_is_ignored(name: str, value: str, unit: str) -> None:
    g = guard(tip_bias_voltage=Limit(step=0.5), zctrl_setpoint=Limit(step=0.5, unit="V"))
    get = Request(int(ControlRequest.PARAM), Parameter(name))
    g.carried_out(get, 0, Parameter(name, "1", "V"))
    assert not why(g, set_("1.2", "V", name))
    assert not g.carried_out(get, 0, Parameter(name, value, unit))
    assert "reports no value now" in why(g, set_("1.2", "V", name))
    assert not g.in_force(Feedback(setpoint=math.nan), 0)


def test_only_applies_to_switches_and_texts() -> None:
    g = guard(x_feedback_on=Limit(only=("corrector",)), x_spec_kind=Limit(only=("corrector",), interval_s=10.0))
    off = Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(on=False))
    requests = (off, set_("false", None, "x-feedback-on"), set_("IV", None, "x-spec-kind"))
    for request in requests:
        assert "only corrector" in why(g, request, "experiment")
        assert not why(g, request, "corrector")
    g.carried_out(requests[2], 0)
    assert "interval is 10 s" in why(g, Request(int(ControlRequest.PARAM), requests[2].subject), "corrector", NS)


HIGH = {"x-high": (Parameter(BIAS, "8", "V"),)}


def test_action_is_limited_by_the_parameters_it_sets() -> None:
    act = Request(int(ControlRequest.ACTION), "x-high", id="i")
    for limit, word in (
        (Limit(high=3.0), "above the highest"),
        (Limit(only=("corrector",)), "only corrector"),
        (Limit(step=0.5), "step of 7 V"),
    ):
        g = checker(ExperimentLimits({BIAS: limit}, sets=HIGH))
        g.carried_out(set_("1", "V"), 0)
        assert word in why(g, act)
        assert "x-high" in why(g, act)
    away = checker(ExperimentLimits(region=STAGE, sets={"x-away": (Parameter("probe-pos-x", "20", "um"),)}))
    away.in_force(ProbePosition((0.0, 0.0)), 0)
    assert "outside the region" in why(away, Request(int(ControlRequest.ACTION), "x-away", id="i"))


def test_parameters_set_by_an_action_are_in_force() -> None:
    g = checker(ExperimentLimits({BIAS: Limit(step=0.5)}, sets=HIGH))
    g.carried_out(Request(int(ControlRequest.ACTION), "x-high"), 0)
    assert not why(g, set_("8.4", "V"))
    assert why(g, set_("1.0", "V"))


def test_parameters_set_by_an_action_are_limited_together() -> None:
    large = (Parameter("scan-resolution-x", "2048"), Parameter("scan-resolution-y", "2048"))
    to_the_left = (Parameter("scan-top-left-x", "-5", "um"), Parameter("scan-size-x", "10", "um"))
    g = checker(ExperimentLimits(region=STAGE, most_pixels=1_000_000, sets={"x-large": large, "x-left": to_the_left}))
    g.in_force(ScanParameters(Region((4e-6, 0.0), (2e-6, 2e-6)), (256, 256)), 0)
    assert "2048 x 2048" in why(g, Request(int(ControlRequest.ACTION), "x-large", id="i"))
    assert not why(g, Request(int(ControlRequest.ACTION), "x-left", id="i"))


@pytest.mark.parametrize(
    ("name", "value"), [("scan-resolution-x", "0"), ("scan-resolution-y", "2.5"), ("scan-size-x", "0")]
)
def test_malformed_place_of_a_microscope_is_ignored(name: str, value: str) -> None:
    g = checker(ExperimentLimits(region=STAGE))
    g.in_force(ScanParameters(Region((0.0, 0.0), (2e-6, 2e-6)), (256, 256)), 0)
    g.carried_out(Request(int(ControlRequest.PARAM), Parameter(name)), 0, Parameter(name, value))
    assert here(g, "start-scan") == ""


def test_value_stays_known_after_a_malformed_request() -> None:
    g = guard(zctrl_setpoint=Limit(step=0.5))
    g.in_force(Feedback(setpoint=1.0), 0)
    assert why(g, set_("nan", None, "zctrl-setpoint"))
    assert g.depends_on(set_("nan", None, "zctrl-setpoint")) == []
    assert not why(g, set_("1.2", None, "zctrl-setpoint"))


def test_a_rate_is_not_measured_from_when_the_value_was_read() -> None:
    """A controller rounds its values, and a change at the panel is part of the total change."""
    g = guard(tip_bias_voltage=Limit(rate_per_s=0.1))
    get = Request(int(ControlRequest.PARAM), Parameter(BIAS))
    g.carried_out(set_("1", "V"), 0)
    g.carried_out(get, 10 * NS, Parameter(BIAS, "1.0004", "V"))
    assert not why(g, set_("1.9", "V"), now_ns=10 * NS)
    assert "per second" in why(g, set_("2.1", "V"), now_ns=10 * NS)
    g.carried_out(get, 10 * NS, Parameter(BIAS, "1.8", "V"))  # somebody was at the panel
    assert "per second" in why(g, set_("1.5", "V"), now_ns=10 * NS)
    assert not why(g, set_("1.5", "V"), now_ns=12 * NS)


def test_read_without_a_value_forgets_the_former_value() -> None:
    g = guard(tip_bias_voltage=Limit(step=0.5))
    get = Request(int(ControlRequest.PARAM), Parameter(BIAS))
    for told in (None, Parameter(BIAS), Parameter("scan-speed", "1")):
        g.carried_out(set_("1", "V"), 0)
        assert not why(g, set_("1.2", "V"))
        g.carried_out(get, 0, told)
        assert "reports no value now" in why(g, set_("1.2", "V"))


@pytest.mark.parametrize("by_action", [True, False])
def test_interval_of_a_parameter_counts_from_its_sending(by_action: bool) -> None:
    limits = ExperimentLimits({BIAS: Limit(interval_s=600.0)}, sets=HIGH)
    request = Request(int(ControlRequest.ACTION), "x-high", id="1") if by_action else set_("1", "V")
    g = checker(limits)
    g.sending("experiment", request, 0)
    assert g.state.usage.sent
    again = restarted(limits, g)
    other = Request(int(ControlRequest.PARAM), Parameter(BIAS, "2", "V"), id="2")
    for one in (g, again):
        assert "interval is 600 s" in why(one, other, now_ns=NS)
    g.not_done("experiment", request)
    assert not why(g, other, now_ns=NS)


FRAME = {"scan-top-left-x", "scan-top-left-y", "scan-size-x", "scan-size-y", "scan-angle"}
PROBE = {"probe-pos-x", "probe-pos-y"}
PIXELS = {"scan-resolution-x", "scan-resolution-y"}


def depends(g: Held[LimitChecker], request: Request, *, is_mapped: bool = False) -> set[str]:
    return set(g.depends_on(request, is_mapped=is_mapped))


def test_request_depends_on_values_with_a_limited_step_or_rate() -> None:
    limits = {BIAS: Limit(step=0.5), "zctrl-setpoint": Limit(rate_per_s=1.0), "scan-speed": Limit(high=1.0)}
    g = checker(ExperimentLimits(limits, sets=HIGH))
    assert depends(g, set_("1", "V")) == depends(g, act("x-high")) == {BIAS}
    assert depends(g, Request(int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(setpoint=1.0))) == {"zctrl-setpoint"}
    assert depends(g, Request(int(ControlRequest.PARAM), Parameter(BIAS))) == set()
    assert depends(g, set_("1e-6", "m/s", "scan-speed")) == set()


def test_place_is_read_as_a_whole_where_one_of_its_values_is_limited() -> None:
    g = checker(ExperimentLimits({"probe-pos-x": Limit(step=1e-6)}))
    assert depends(g, set_("1", "um", "probe-pos-x")) == {"probe-pos-x", "probe-pos-y"}


def test_part_of_a_place_and_action_there_depend_on_the_place() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    assert depends(g, set_("1", "um", "scan-size-x")) == depends(g, scan(RegionChange(left_m=0.0))) == FRAME
    assert depends(g, act("start-scan")) == FRAME
    assert depends(g, set_("1", "um", "probe-pos-x")) == depends(g, act("start-spec")) == PROBE
    assert depends(g, act("x-pulse")) == depends(g, act("x-crash")) == PROBE
    whole = (scan(Region((0.0, 0.0), (1e-6, 1e-6))), probe(0.0, 0.0), act("stop-scan"), act("x-retract"))
    for request in whole:
        assert depends(g, request) == set()
    assert depends(g, set_("128", "px", "scan-resolution-x")) == PIXELS
    assert depends(g, scan(shape=(64, 64))) == set()


def test_place_without_a_region_limit_matters_only_if_mapped() -> None:
    g = checker()
    for request, place in ((act("start-scan"), FRAME), (set_("1", "um", "probe-pos-x"), PROBE)):
        assert depends(g, request) == set()
        assert depends(g, request, is_mapped=True) == place


def read_place(g: Held[LimitChecker], **values: str | None) -> None:
    told = {name.replace("_", "-"): value for name, value in values.items()}
    g.was_read({name: None if v is None else Parameter(name, v, "um") for name, v in told.items()}, 0)


def test_read_place_replaces_the_published_one() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    g.in_force(ScanParameters(Region((0, 0), (1e-6, 1e-6)), (8, 8)), 0)
    read_place(g, scan_top_left_x="4.9", scan_top_left_y="0", scan_size_x="1", scan_size_y="1")
    assert "corner" in here(g, "start-scan")
    read_place(g, scan_top_left_x="4")
    assert here(g, "start-scan") == ""


@pytest.mark.parametrize("wrong", [None, "nan", "0"])
def test_place_with_an_unreadable_part_is_unknown(wrong: str | None) -> None:
    g = checker(ExperimentLimits(region=STAGE))
    g.in_force(ScanParameters(Region((0, 0), (1e-6, 1e-6)), (8, 8)), 0)
    read_place(g, scan_top_left_x="0", scan_top_left_y="0", scan_size_x=wrong, scan_size_y="1")
    assert "not reported" in here(g, "start-scan")


def test_place_is_unknown_after_an_unknown_outcome_until_it_is_read() -> None:
    g = checker(ExperimentLimits(region=STAGE))
    g.in_force(ScanParameters(Region((0, 0), (1e-6, 1e-6), 0.5), (8, 8)), 0)
    g.in_force(ProbePosition((0.0, 0.0)), 0)
    g.unknown(set_("9", "um", "scan-size-x"))
    assert "not reported" in here(g, "start-scan")
    assert here(g, "x-pulse") == ""
    read_place(g, scan_top_left_x="0", scan_top_left_y="0", scan_size_x="1", scan_size_y="1")  # it can't be turned
    assert here(g, "start-scan") == ""
    g.unknown(probe(9e-6, 0.0))
    assert "not reported" in here(g, "x-pulse")
    read_place(g, probe_pos_x="9", probe_pos_y="0")
    assert "outside the region" in here(g, "x-pulse")


def test_pixels_are_read_together_after_an_unknown_outcome() -> None:
    g = checker(ExperimentLimits(most_pixels=1000))
    g.in_force(ScanParameters(STAGE, (10, 10)), 0)
    g.unknown(set_("900", "px", "scan-resolution-y"))
    told = {
        "scan-resolution-x": Parameter("scan-resolution-x", "10"),
        "scan-resolution-y": Parameter("scan-resolution-y", "90"),
    }
    g.was_read(told, 0)
    assert "12 x 90" in why(g, set_("12", "px", "scan-resolution-x"))


def test_rate_counts_from_the_reading_after_an_unknown_outcome() -> None:
    g = guard(tip_bias_voltage=Limit(rate_per_s=0.1))
    g.carried_out(set_("1", "V"), 0)
    g.sending("experiment", set_("2", "V"), 20 * NS)
    again = restarted(g.limits, g)  # killed before the answer
    for one in (g, again):
        one.unknown(set_("2", "V")) if one is g else None
        one.was_read({BIAS: Parameter(BIAS, "2", "V")}, 30 * NS)
        assert "per second" in why(one, set_("2.2", "V"), now_ns=31 * NS)
        assert not why(one, set_("2.1", "V"), now_ns=31 * NS)


def test_rate_counts_as_before_after_a_refused_change() -> None:
    g = guard(tip_bias_voltage=Limit(rate_per_s=0.1))
    g.carried_out(set_("1", "V"), 0)
    g.sending("experiment", set_("2", "V"), 20 * NS)
    assert "reports no value now" in why(g, set_("2", "V"), now_ns=20 * NS)
    g.not_done("experiment", set_("2", "V"))
    assert not why(g, set_("3", "V"), now_ns=20 * NS)
