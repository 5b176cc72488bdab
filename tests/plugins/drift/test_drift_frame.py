"""Components use sample coordinates: each request and packet is mapped, as a whole place, both ways."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.plugins.drift.drift_lab import HERE, NS, SHAPE, START_S, Lab, forecast

from afspm import wire
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    ScanParameters,
    ScopeState,
    Spectrum,
    names,
)
from afspm.plugins.drift.frame.settings import DriftCompensationSettings
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.events import Publish
from afspm.scheduler.safety.limits import Limit

DRIFT = (100e-9, -50e-9)
TURN = math.radians(10.0)
THERE = Region((1e-6, 2e-6), (1e-6, 0.5e-6), math.radians(30.0))


@pytest.fixture
def lab() -> Lab:
    """The sample has moved by DRIFT, and a component is in control."""
    made = Lab()
    made.in_force()
    made.take_control()
    made.knows(forecast(DRIFT))
    made.effects.clear()
    return made


def set_region(lab: Lab, region: Region | RegionChange | None, shape: tuple[int, int] | None = None) -> ScanParameters:
    """Request a region and let the microscope set it; return the request that reached the microscope."""
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(region, shape))
    forward = lab.sent()
    assert forward.request.kind == ControlRequest.SET_SCAN_PARAMS
    lab.answer(forward)
    told: ScanParameters = wire.decode("ScanParameters2d", forward.request.payload)
    return told


def same(a: Region, b: Region) -> None:
    np.testing.assert_allclose(a.corners_m(), b.corners_m(), atol=1e-16)


def moved(region: Region, by_m: tuple[float, float]) -> Region:
    return region.moved_to((region.center_m[0] + by_m[0], region.center_m[1] + by_m[1]))


def test_a_region_is_sent_to_its_place_on_the_sample(lab: Lab) -> None:
    sent = set_region(lab, THERE, (64, 32))
    assert isinstance(sent.region, Region)
    same(sent.region, moved(THERE, DRIFT))
    assert sent.shape == (64, 32)


def test_a_rotated_sample_rotates_the_region(lab: Lab) -> None:
    lab.knows(forecast(angle_rad=-TURN))
    sent = set_region(lab, THERE)
    assert isinstance(sent.region, Region)
    assert sent.region.angle_rad == pytest.approx(THERE.angle_rad + TURN)
    x, y = THERE.center_m
    turned = (x * math.cos(TURN) - y * math.sin(TURN), x * math.sin(TURN) + y * math.cos(TURN))
    assert sent.region.center_m == pytest.approx(turned, abs=1e-16)


@pytest.mark.parametrize(
    "change",
    [RegionChange(left_m=0.3e-6), RegionChange(width_m=0.4e-6, height_m=0.2e-6), RegionChange(angle_rad=0.5)],
)
def test_a_part_of_a_region_is_combined_with_the_region_in_sample_coordinates_and_mapped_whole(
    lab: Lab, change: RegionChange
) -> None:
    lab.knows(forecast(DRIFT, angle_rad=-TURN))
    set_region(lab, THERE)
    lab.knows(forecast((-7e-9, 3e-9), angle_rad=-TURN))
    sent = set_region(lab, change)
    assert isinstance(sent.region, Region)
    same(sent.region, lab.mapping_now().to_tip(change.onto(THERE)))


def test_a_part_of_an_unknown_region_is_refused_with_a_hint() -> None:
    lab = Lab()
    lab.take_control()
    lab.effects.clear()
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(RegionChange(left_m=0.0)))
    (reply,) = lab.replies()
    assert reply.code == ControlResponse.PARAM_ERROR
    assert "set the whole region" in reply.reason
    assert not lab.forwards()


def test_pixels_alone_move_nothing(lab: Lab) -> None:
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(None, (16, 16)))
    assert wire.decode("ScanParameters2d", lab.sent().request.payload) == ScanParameters(None, (16, 16))


def test_a_requested_region_is_published_back_to_the_last_bit(lab: Lab) -> None:
    """Also in the unit of the request, though the controller rounds."""
    from afspm.wire.generated.scan_pb2 import ScanParameters2d

    message = ScanParameters2d()
    roi = message.spatial.roi
    roi.top_left.x, roi.top_left.y, roi.size.x, roi.size.y, roi.angle = 0.1, 0.2, 0.7, 0.3, 12.3
    message.spatial.length_units, message.spatial.angular_units = "um", "deg"
    asked = wire.decode("ScanParameters2d", message.SerializeToString())
    from afspm.model import Request
    from afspm.scheduler.events import RequestIn

    payload = message.SerializeToString()
    lab.step(RequestIn(lab.connections["series"], "series", Request(3, asked, payload, "series/life/x")))
    lab.answer(lab.sent())
    tip = moved(asked.region, DRIFT)
    rounded = tip.moved_to((round(tip.center_m[0], 10), round(tip.center_m[1], 10)))
    assert rounded != tip
    lab.effects.clear()
    lab.publish(ScanParameters(rounded, SHAPE))
    packet = next(e.packet for e in lab.effects if hasattr(e, "packet"))
    assert ScanParameters2d.FromString(bytes(packet.payload)).spatial == message.spatial


def test_a_region_published_before_its_answer_is_recognised(lab: Lab) -> None:
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(THERE))
    lab.effects.clear()
    lab.publish(ScanParameters(moved(THERE, DRIFT), SHAPE))
    (told,) = lab.published("ScanParameters2d")
    assert told.region == THERE


def test_a_region_set_at_the_panel_is_published_in_sample_coordinates_and_kept_there(lab: Lab) -> None:
    lab.publish(ScanParameters(THERE, SHAPE))
    (told,) = lab.published("ScanParameters2d")
    same(told.region, moved(THERE, (-DRIFT[0], -DRIFT[1])))
    lab.knows(forecast((0.0, 0.0)))
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    sent = wire.decode("ScanParameters2d", lab.sent().request.payload)
    same(sent.region, told.region)


@pytest.mark.parametrize("drift_m", [DRIFT, (0.0, 0.0)])
def test_the_probe_is_sent_to_the_place_on_the_sample_and_published_back(
    lab: Lab, drift_m: tuple[float, float]
) -> None:
    lab.knows(forecast(drift_m))
    lab.ask(ControlRequest.SET_PROBE_POS, ProbePosition((0.1e-6, 0.3e-6)))
    forward = lab.sent()
    at = wire.decode("ProbePosition", forward.request.payload)
    assert at.xy_m == pytest.approx((0.1e-6 + drift_m[0], 0.3e-6 + drift_m[1]), abs=1e-18)
    lab.answer(forward)
    lab.effects.clear()
    lab.publish(at)
    assert lab.published("ProbePosition") == [ProbePosition((0.1e-6, 0.3e-6))]


def test_one_coordinate_is_mapped_as_a_whole_position_on_a_rotated_sample(lab: Lab) -> None:
    lab.knows(forecast(angle_rad=-math.pi / 2))
    lab.ask(ControlRequest.SET_PROBE_POS, ProbePosition((1e-6, 2e-6)))
    lab.answer(lab.sent())
    lab.ask(ControlRequest.SET_PROBE_POS, PositionChange(x_m=3e-6))
    at = wire.decode("ProbePosition", lab.sent().request.payload)
    assert at.xy_m == pytest.approx((-2e-6, 3e-6), abs=1e-18)


def test_one_coordinate_of_an_unknown_position_is_refused() -> None:
    lab = Lab()
    lab.take_control()
    lab.effects.clear()
    lab.ask(ControlRequest.PARAM, Parameter(names.PROBE_POS_X, "1", "um"))
    assert "set x and y" in lab.replies()[0].reason
    assert not lab.forwards()


@pytest.mark.parametrize(
    ("name", "value", "unit", "change"),
    [
        (names.SCAN_TOP_LEFT_X, "0.25", "um", RegionChange(left_m=0.25e-6)),
        (names.SCAN_TOP_LEFT_Y, "1e-7", None, RegionChange(low_m=1e-7)),
        (names.SCAN_SIZE_X, "300", "nm", RegionChange(width_m=3e-7)),
        (names.SCAN_SIZE_Y, "300", "nm", RegionChange(height_m=3e-7)),
        (names.SCAN_ANGLE, "45", None, RegionChange(angle_rad=math.pi / 4)),
    ],
)
def test_a_parameter_of_the_region_is_set_as_a_part_of_the_whole(
    lab: Lab, name: str, value: str, unit: str | None, change: RegionChange
) -> None:
    lab.knows(forecast(DRIFT, angle_rad=-TURN))
    set_region(lab, THERE)
    lab.effects.clear()
    lab.ask(ControlRequest.PARAM, Parameter(name, value, unit), id_="series/life/p")
    forward = lab.sent()
    assert forward.request.kind == ControlRequest.SET_SCAN_PARAMS
    assert forward.request.id == "series/life/p"
    sent = wire.decode("ScanParameters2d", forward.request.payload)
    same(sent.region, lab.mapping_now().to_tip(change.onto(THERE)))
    lab.answer(forward)
    (reply,) = lab.replies()
    assert wire.decode_parameter(reply.payload) == Parameter(name, value, unit)


@pytest.mark.parametrize(
    ("name", "tip_value", "unit", "expected"),
    [
        (names.SCAN_TOP_LEFT_X, 0.5e-6 + DRIFT[0], "nm", 500.0),
        (names.SCAN_TOP_LEFT_Y, 1.75e-6 + DRIFT[1], "m", 1.75e-6),
        (names.SCAN_SIZE_X, 1e-6, "um", 1.0),
        (names.SCAN_ANGLE, 30.0, "deg", 30.0),
    ],
)
def test_a_parameter_of_the_region_is_read_in_sample_coordinates(
    lab: Lab, name: str, tip_value: float, unit: str, expected: float
) -> None:
    from afspm.basics.units import convert

    set_region(lab, THERE)
    lab.effects.clear()
    lab.ask(ControlRequest.PARAM, Parameter(name, None, unit))
    told = tip_value if unit == "deg" else convert(tip_value, "m", unit)
    lab.answer(lab.sent(), told=Parameter(name, repr(told), unit))
    answer = wire.decode_parameter(lab.replies()[0].payload)
    assert answer.unit == unit
    assert float(answer.value or "") == pytest.approx(expected, rel=1e-12)


def test_a_size_of_zero_from_the_microscope_is_passed_on(lab: Lab) -> None:
    set_region(lab, THERE)
    lab.effects.clear()
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_SIZE_X))
    told = Parameter(names.SCAN_SIZE_X, "0", "m")
    lab.answer(lab.sent(), told=told)
    assert wire.decode_parameter(lab.replies()[0].payload) == told


def test_the_probe_s_parameters_are_read_in_sample_coordinates(lab: Lab) -> None:
    lab.publish(ProbePosition((5e-7, 5e-7)))
    lab.effects.clear()
    lab.ask(ControlRequest.PARAM, Parameter(names.PROBE_POS_Y))
    lab.answer(lab.sent(), told=Parameter(names.PROBE_POS_Y, "5e-7", "m"))
    answer = wire.decode_parameter(lab.replies()[0].payload)
    assert float(answer.value or "") == pytest.approx(5e-7 - DRIFT[1])


@pytest.mark.parametrize("asked", [Parameter("tip-bias-voltage", "1", "V"), Parameter(names.SCAN_SPEED, "1", "um/s")])
def test_requests_without_a_place_pass_unchanged(lab: Lab, asked: Parameter) -> None:
    lab.ask(ControlRequest.PARAM, asked)
    assert lab.sent().request.payload == wire.encode(asked)[1]


# --- where the sample is by then ---


def test_a_region_is_sent_to_the_predicted_place_for_the_middle_of_the_scan(lab: Lab) -> None:
    lab.scan(duration_s=200.0)
    lab.knows(forecast(rate_m_s=(1e-9, 0.0), at_s=lab.now_s))
    sent = set_region(lab, HERE)
    assert isinstance(sent.region, Region)
    assert sent.region.center_m[0] == pytest.approx(100e-9, rel=1e-4)


def test_before_a_scan_the_microscope_is_moved_after_the_sample_and_then_started(lab: Lab) -> None:
    set_region(lab, HERE)
    lab.knows(forecast((30e-9, 0.0)))
    lab.effects.clear()
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    move = lab.sent()
    assert (move.request.kind, move.request.id) == (ControlRequest.SET_SCAN_PARAMS, "")
    told = wire.decode("ScanParameters2d", move.request.payload)
    assert told.region.center_m == pytest.approx((30e-9, 0.0), abs=1e-18)
    lab.scope_is(ScopeState.MOVING)
    lab.answer(move)
    assert not lab.forwards()  # it would be refused now
    lab.scope_is(ScopeState.FREE)
    # who waits for the scan would take that for its end, and ask for the next
    assert not [one for one in lab.effects if isinstance(one, Publish) and one.packet.envelope == "ScopeStateMsg"]
    go = lab.sent()
    assert (go.request.subject, go.request.id) == (names.START_SCAN, "series/life/go")
    lab.answer(go)
    assert [reply.code for reply in lab.replies()] == [ControlResponse.SUCCESS]


def test_a_microscope_that_publishes_no_move_is_started_all_the_same(lab: Lab) -> None:
    from afspm.scheduler.events import Tick

    lab.knows(forecast((30e-9, 0.0)))
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    lab.answer(lab.sent())
    assert not lab.forwards()
    for _ in range(2):  # that the move was made is written down first
        due_s = lab.core.deadline_s()
        assert due_s is not None
        lab.now_s = due_s
        lab.step(Tick())
    assert lab.sent().request.subject == names.START_SCAN


def test_a_move_that_fails_is_the_answer_to_the_action(lab: Lab) -> None:
    lab.knows(forecast((30e-9, 0.0)))
    lab.effects.clear()
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    lab.answer(lab.sent(), ControlResponse.PARAM_ERROR)
    (reply,) = lab.replies()
    assert (reply.code, reply.id) == (ControlResponse.PARAM_ERROR, "series/life/go")
    assert not lab.forwards()


def test_losing_control_during_the_move_is_answered_and_nothing_is_scanned(lab: Lab) -> None:
    lab.knows(forecast((30e-9, 0.0)))
    lab.effects.clear()
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    move = lab.sent()
    lab.ask(ControlRequest.ADD_EXP_PRBLM, 1, name="other")
    assert ControlResponse.NOT_IN_CONTROL in [reply.code for reply in lab.replies()]
    lab.answer(move)
    lab.scope_is(ScopeState.FREE)
    assert names.START_SCAN not in [forward.request.subject for forward in lab.forwards()]


def test_an_action_repeated_during_the_move_is_done_once(lab: Lab) -> None:
    lab.knows(forecast((30e-9, 0.0)))
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    lab.answer(lab.sent())
    lab.scope_is(ScopeState.FREE)
    assert lab.sent().request.id == "series/life/go"


def test_a_hundredth_of_a_pixel_is_not_worth_a_move(lab: Lab) -> None:
    set_region(lab, HERE)
    pixel_m = HERE.size_m[0] / (SHAPE[1] - 1)
    lab.knows(forecast((DRIFT[0] + 0.009 * pixel_m, DRIFT[1])))
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    lab.answer(lab.sent())
    lab.knows(forecast((DRIFT[0] + 0.011 * pixel_m, DRIFT[1])))
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    assert lab.sent().request.kind == ControlRequest.SET_SCAN_PARAMS


@pytest.mark.parametrize("action", [names.START_SPEC, names.PULSE, names.CRASH])
def test_before_an_action_at_the_probe_the_probe_is_moved_after_the_sample(lab: Lab, action: str) -> None:
    lab.ask(ControlRequest.SET_PROBE_POS, ProbePosition((1e-7, 0.0)))
    lab.answer(lab.sent())
    lab.knows(forecast((1e-9, 2e-9)))
    lab.ask(ControlRequest.ACTION, action)
    at = wire.decode("ProbePosition", lab.sent().request.payload)
    assert at.xy_m == pytest.approx((1.01e-7, 2e-9), abs=1e-18)


def test_a_spectrum_lies_where_the_sample_was_at_its_own_time(lab: Lab) -> None:
    lab.knows(forecast(rate_m_s=(1e-9, 0.0)))
    curves = np.ones((3, 2))
    spectrum = Spectrum((5e-7, 0.0), "IV", ("V", "I"), ("V", "A"), curves, round((START_S + 100.0) * NS))
    lab.publish(spectrum, START_S + 500.0)
    (told,) = lab.published("Spec1d")
    assert told.position_m == pytest.approx((4e-7, 0.0), abs=1e-15)
    np.testing.assert_array_equal(told.values, curves)


# --- limits ---


def limited(**limits: Limit) -> Lab:
    stage = Region((0.0, 0.0), (4e-6, 4e-6))
    lab = Lab(limits=ExperimentLimits({name.replace("_", "-"): limit for name, limit in limits.items()}, region=stage))
    lab.in_force()
    lab.take_control()
    lab.knows(forecast((1.5e-6, 0.0)))
    lab.effects.clear()
    return lab


def test_limits_hold_in_tip_coordinates_and_the_refusal_names_both_places() -> None:
    lab = limited()
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(HERE))
    (reply,) = lab.replies()
    assert reply.code == ControlResponse.PARAM_ERROR
    assert "(1.5, 0) µm at the tip" in reply.reason
    assert "(0, 0) nm on the sample" in reply.reason
    assert not lab.forwards()


def test_a_scan_that_has_drifted_out_of_its_limits_is_refused_at_its_start() -> None:
    lab = limited()
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    (reply,) = lab.replies()
    assert reply.code == ControlResponse.PARAM_ERROR
    assert "at the tip" in reply.reason
    assert not lab.forwards()


def test_a_client_that_may_not_rotate_a_scan_may_move_it() -> None:
    lab = limited(scan_angle=Limit(only=("other",)))
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_TOP_LEFT_X, "-2.5", "um"))
    lab.answer(lab.sent())
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(RegionChange(angle_rad=0.0)))
    assert lab.replies()[-1].code == ControlResponse.PARAM_ERROR
    assert "only other" in lab.replies()[-1].reason


# --- once ---


def test_a_repeated_request_reaches_the_microscope_with_the_same_bytes(lab: Lab) -> None:
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(THERE), id_="series/life/same")
    first = lab.sent()
    lab.answer(first, ControlResponse.NO_RESPONSE)
    again = Lab(state=lab.saved())  # and the scheduler was killed meanwhile
    again.take_control()
    again.knows(forecast((500e-9, 0.0)))
    again.effects.clear()
    again.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(THERE), id_="series/life/same")
    second = again.sent()
    assert (second.request.kind, second.request.payload) == (first.request.kind, first.request.payload)
    again.answer(second)
    again.effects.clear()
    again.publish(wire.decode("ScanParameters2d", first.request.payload))
    assert again.published("ScanParameters2d")[0].region == THERE


def test_places_in_force_are_known_in_both_coordinates_after_a_restart(lab: Lab) -> None:
    set_region(lab, THERE, SHAPE)
    lab.take_control("series")
    lab.ask(ControlRequest.RELEASE_CTRL)
    again = Lab(state=lab.saved())
    again.effects.clear()
    again.publish(ScanParameters(moved(THERE, DRIFT), SHAPE))
    assert again.published("ScanParameters2d")[0].region == THERE


# --- without correction ---


@pytest.mark.parametrize(
    "drift", [DriftCompensationSettings(correct=False), DriftCompensationSettings(correct_after=1000.0)]
)
def test_without_correction_nothing_is_mapped(drift: DriftCompensationSettings) -> None:
    lab = Lab(drift)
    lab.in_force()
    lab.take_control()
    lab.knows(forecast(DRIFT))
    asked = wire.encode(ScanParameters(THERE))[1]
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(THERE))
    forward = lab.sent()
    assert forward.request.payload == asked
    lab.answer(forward)
    lab.effects.clear()
    lab.publish(ScanParameters(THERE, SHAPE))
    assert lab.published("ScanParameters2d")[0].region == THERE
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    assert lab.sent().request.subject == names.START_SCAN


def test_a_scan_after_correction_begins_is_moved_after_the_sample() -> None:
    lab = Lab(DriftCompensationSettings(correct_after=1000.0))
    lab.in_force()
    lab.take_control()
    lab.knows(forecast(DRIFT))
    lab.now_s += 1000.0
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    told = wire.decode("ScanParameters2d", lab.sent().request.payload)
    same(told.region, moved(HERE, DRIFT))


def test_an_action_sent_before_a_kill_is_repeated_without_a_move(lab: Lab) -> None:
    """The action may have begun: the busy microscope would refuse a move."""
    set_region(lab, HERE)
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    assert lab.sent().request.id == "series/life/go"
    again = Lab(state=lab.saved())
    again.take_control()
    again.knows(forecast((500e-9, 0.0)))
    again.forwards()
    again.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    assert again.sent().request.id == "series/life/go"


def region_of(lab: Lab) -> Region:
    told = wire.decode("ScanParameters2d", lab.sent().request.payload)
    assert isinstance(told.region, Region)
    return told.region


def test_parts_sent_without_waiting_are_combined(lab: Lab) -> None:
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_SIZE_X, "1", "um"))
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_TOP_LEFT_X, "0.5", "um"))
    wider = lab.sent()
    lab.knows(forecast((DRIFT[0] + 3e-9, DRIFT[1])))  # more is known of the drift when the second is sent
    lab.answer(wider)
    wanted = Region.from_top_left((0.5e-6, -1e-6), (1e-6, 2e-6))
    same(region_of(lab), moved(wanted, (DRIFT[0] + 3e-9, DRIFT[1])))


def test_burst_stays_in_the_region_in_sample_coordinates() -> None:
    lab = limited()
    set_region(lab, Region.from_top_left((-3e-6, -1e-6), (1e-6, 1e-6)))
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_SIZE_X, "2.5", "um"))  # each of the two fits by itself
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_TOP_LEFT_X, "-1.5", "um"))
    lab.answer(lab.sent())
    assert (lab.forwards(), lab.replies()[-1].code) == ([], ControlResponse.PARAM_ERROR)
    assert "outside the region" in lab.replies()[-1].reason


def test_place_is_read_again_after_the_move_before_an_action() -> None:
    lab = limited()
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(Region((-2e-6, 0.0), (1e-6, 1e-6))))
    lab.answer(lab.sent())
    lab.knows(forecast((1.4e-6, 0.0)))
    lab.ask(ControlRequest.ACTION, names.START_SCAN)
    lab.answer(lab.sent())
    lab.places[names.SCAN_TOP_LEFT_X] = 2e-6  # a person uses the controller's panel
    lab.scope_is(ScopeState.FREE)
    assert lab.forwards() == []
    assert "outside the region" in lab.replies()[-1].reason


def test_request_that_reads_passes_while_the_microscope_moves_for_an_action(lab: Lab) -> None:
    set_region(lab, HERE)
    lab.knows(forecast((DRIFT[0] + 50e-9, DRIFT[1])))
    lab.ask(ControlRequest.ACTION, names.START_SCAN, id_="series/life/go")
    lab.answer(lab.sent())
    lab.scope_is(ScopeState.MOVING)
    lab.ask(ControlRequest.PARAM, Parameter(names.SCAN_SPEED), name="other")
    read = lab.sent()
    assert read.request.subject == Parameter(names.SCAN_SPEED)
    lab.answer(read)
    lab.scope_is(ScopeState.FREE)
    assert lab.sent().request.id == "series/life/go"
