"""A sweep measures each point once with its parameters in force, and sets them back, whatever is killed or lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from client_lab import SCAN_S, Kill9, Lab, LabPort, scope_of

from afspm import wire
from afspm.basics.errors import InvalidValue, Refused
from afspm.client.scope import Scope
from afspm.model import (
    ControlRequest,
    ControlResponse,
    MeasurementConditions,
    Parameter,
    Problem,
    Region,
    Request,
    Response,
    ResponseDetail,
    ScopeState,
    Spectrum,
    TipStatus,
    names,
)
from afspm.model.events import MeasurementSettings
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST, Settings
from afspm.model.sweep_plan import SweptValues
from afspm.scheduler.control.arbitration import ArbitrationEvent

SWEPT: dict[str, SweptValues] = {"tip-bias-voltage": ["0.1 V", "0.2 V"], "zctrl-igain": [1, 2]}
SNAKE = [("0.1", "1"), ("0.1", "2"), ("0.2", "2"), ("0.2", "1")]
TWO_POINTS: dict[str, SweptValues] = {"tip-bias-voltage": ["0.1 V", "0.2 V"], "zctrl-igain": [1]}
BEFORE = ("0.5", "7")


class SweepLab(Lab):
    """Notes the parameters in force when each scan or spectrum ends."""

    def __init__(self) -> None:
        super().__init__()
        self.values["zctrl-igain"] = BEFORE[1]
        self.measured: list[tuple[str, str]] = []

    @property
    def in_force(self) -> tuple[str, str]:
        return self.values["tip-bias-voltage"], self.values["zctrl-igain"]

    def finish_scan(self) -> None:
        self.measured.append(self.in_force)
        super().finish_scan()

    def finish_spectrum(self) -> None:
        self.measured.append(self.in_force)
        super().finish_spectrum()


def sweep(scope: Scope, key: str | None = "gains", swept: dict[str, SweptValues] = SWEPT) -> list[Any]:
    with scope.sweep(swept, shape=(8, 8), key=key) as points:
        return list(points)


def test_each_point_is_measured_with_its_parameters_in_force_and_they_are_set_back() -> None:
    lab = SweepLab()
    points = sweep(scope_of(lab), key=None)
    assert lab.measured == SNAKE
    assert lab.in_force == BEFORE
    assert [point.values["tip-bias-voltage"] for point in points] == [0.1, 0.1, 0.2, 0.2]
    assert [(point.number, point.of) for point in points] == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert lab.control.holder is None
    assert lab.count(ControlRequest.REQUEST_CTRL) == 4, "others may measure between two points"


def test_spectra_are_swept_too() -> None:
    lab = SweepLab()
    with scope_of(lab).sweep(SWEPT, measure="spectrum", at=(1e-7, 0.0), kind="IV") as points:
        assert [point.spectrum.kind for point in points] == ["IV"] * 4
    assert lab.measured == SNAKE
    assert lab.in_force == BEFORE


class ShowsConditions(SweepLab):
    """Publishes the swept values at begin and end before each result, in mV, as a translator does."""

    def finish_scan(self) -> None:
        volts, gain = self.in_force
        begin = (Parameter("tip-bias-voltage", str(1e3 * float(volts)), "mV"), Parameter("zctrl-igain", gain))
        self.publish(MeasurementConditions(self.clock.now_ns(), "", begin_values=begin, end_values=begin[:1]))
        super().finish_scan()


# results C3
def test_point_has_the_values_in_force_beside_those_of_the_plan_also_after_a_restart(tmp_path: Path) -> None:
    lab = ShowsConditions()
    points = sweep(scope_of(lab, tmp_path), swept=TWO_POINTS)
    lab.restart_component()
    again = sweep(scope_of(lab, tmp_path, 1), swept=TWO_POINTS)
    assert len(lab.measured) == 2
    for found in (points, again):
        assert [one.in_force["tip-bias-voltage"] for one in found] == [pytest.approx((v, v)) for v in (0.1, 0.2)]
        assert [one.in_force["zctrl-igain"] for one in found] == [(1.0, None)] * 2


def test_point_of_an_earlier_version_or_another_translator_shows_no_values_in_force(tmp_path: Path) -> None:
    lab = SweepLab()
    sweep(scope_of(lab, tmp_path))
    lab.restart_component()
    assert [one.in_force for one in sweep(scope_of(lab, tmp_path, 1))] == [{}] * 4


@pytest.mark.parametrize("is_noticed", [True, False])
@pytest.mark.parametrize("is_late", [True, False])
def test_killed_at_any_step_each_point_is_measured_once_and_the_parameters_are_set_back(
    *, is_late: bool, is_noticed: bool
) -> None:
    for deadly_call in range(1, 1000):
        lab = SweepLab()
        with TemporaryDirectory() as folder:
            try:
                sweep(scope_of(lab, Path(folder), 0, LabPort(lab, deadly_call, is_late=is_late)), swept=TWO_POINTS)
                break  # survived: all steps were tried
            except Kill9:
                pass
            if is_noticed:
                lab.does(ArbitrationEvent.DEAD, lab.name)
            lab.restart_component()
            assert len(sweep(scope_of(lab, Path(folder), 1), swept=TWO_POINTS)) == 2
        assert lab.measured == [("0.1", "1"), ("0.2", "1")], f"killed at call {deadly_call}"
        assert lab.in_force == BEFORE, f"killed at call {deadly_call}"
    assert deadly_call > 30


def test_parameters_that_others_changed_while_control_was_lost_are_set_again() -> None:
    lab = SweepLab()

    def repair() -> None:
        lab.flag(Problem.TIP_SHAPE_CHANGED)
        lab.values["tip-bias-voltage"] = "3.0"

    lab.at(1.5 * SCAN_S, repair)
    lab.at(3.0 * SCAN_S, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    points = sweep(scope_of(lab), key=None)
    assert lab.measured == SNAKE
    assert [len(point.scans.interruptions) for point in points] == [0, 1, 0, 0]
    assert lab.in_force == BEFORE


@pytest.mark.parametrize("leave", [lambda lab: lab.ctrl_c(), None])
def test_parameters_are_set_back_however_the_block_ends(leave: Callable[[Lab], None] | None) -> None:
    lab = SweepLab()
    if leave is not None:
        lab.at(1.5 * SCAN_S, lambda: leave(lab))

    def look(scope: Scope) -> None:
        with scope.sweep(SWEPT) as points:
            for point in points:
                if leave is None and point.number == 2:
                    raise ZeroDivisionError

    with pytest.raises((KeyboardInterrupt, ZeroDivisionError)):
        look(scope_of(lab))
    assert lab.in_force == BEFORE
    assert lab.control.holder is None


def test_a_refused_value_ends_the_sweep_and_the_parameters_are_set_back() -> None:
    lab = SweepLab()

    def limit(request: Request) -> Response | str:
        is_above = isinstance(request.subject, Settings) and request.subject.parameters[0].value == "0.2"
        return Response(ControlResponse.PARAM_ERROR, reason="above 0.15 V") if is_above else "go on"

    lab.intercept = limit
    with pytest.raises(Refused, match=r"above 0\.15 V"):
        sweep(scope_of(lab))
    assert lab.measured == SNAKE[:2]
    assert lab.in_force == BEFORE


def test_the_settings_are_published_before_each_measurement_and_their_end_too() -> None:
    lab = SweepLab()
    sweep(scope_of(lab))
    messages = [wire.decode(one.message, one.payload) for one in lab.told("MeasurementSettings")]
    assert all(isinstance(one, MeasurementSettings) and one.who == lab.name for one in messages)
    assert [tuple(p.value for p in one.parameters) for one in messages] == [*SNAKE, ()]
    assert [one.key for one in messages] == ["gains-1", "gains-2", "gains-3", "gains-4", ""]


def test_a_key_with_other_values_is_refused_before_anything_is_set(tmp_path: Path) -> None:
    lab = SweepLab()
    sweep(scope_of(lab, tmp_path))
    lab.restart_component()
    with (
        pytest.raises(InvalidValue, match="was used for another measurement"),
        scope_of(lab, tmp_path, 1).sweep({"zctrl-igain": [3]}, shape=(8, 8), key="gains") as points,
    ):
        list(points)
    assert len(lab.measured) == 4
    assert lab.in_force == BEFORE


class SourceLab(SweepLab):
    """A microscope beside a voltage source, whose value arrives some readings after a new target."""

    def __init__(self) -> None:
        super().__init__()
        self.values |= {"source.bias": "4.2", "source.bias.target": "4.2", "source.bias.busy": "false"}
        self.readings_left = 0
        self.at_volt: list[str] = []
        self.targets: list[str | None] = []

    def execute(self, request: Request) -> Response:
        subject = request.subject
        if isinstance(subject, Parameter) and subject.name.startswith("source.bias"):
            if subject.value is not None:
                self.targets.append(subject.value)
                self.values |= {"source.bias.target": subject.value, "source.bias.busy": "true"}
                self.readings_left = 5
            elif subject.name == "source.bias.busy" and self.values["source.bias.busy"] == "true":
                self.readings_left -= 1
                if self.readings_left == 0:
                    self.values |= {"source.bias": self.values["source.bias.target"], "source.bias.busy": "false"}
        return super().execute(request)

    def finish_scan(self) -> None:
        self.at_volt.append(self.values["source.bias"])
        super().finish_scan()


BIASES: dict[str, SweptValues] = {"source.bias": ["4.2 V", "10 V"], "zctrl-igain": [1, 2]}


def test_target_of_an_instrument_is_set_once_awaited_and_set_back() -> None:
    lab = SourceLab()
    assert [point.values["source.bias"] for point in sweep(scope_of(lab), None, BIASES)] == [4.2, 4.2, 10.0, 10.0]
    assert lab.at_volt == ["4.2", "4.2", "10", "10"]
    assert lab.targets == ["10", "4.2"], "a target in force is not set again"
    assert lab.values["source.bias.target"] == "4.2"
    *published, _ = [wire.decode(one.message, one.payload) for one in lab.told("MeasurementSettings")]
    assert [one.parameters[0].name for one in published if isinstance(one, MeasurementSettings)] == [
        "source.bias.target"
    ] * 4


def test_target_that_another_set_while_control_was_lost_is_set_again() -> None:
    lab = SourceLab()

    def taken_over() -> None:
        lab.flag(Problem.TIP_SHAPE_CHANGED)
        lab.values |= {"source.bias.target": "77", "source.bias": "77", "source.bias.busy": "false"}

    lab.at(SCAN_S + 1.0, taken_over)
    lab.at(SCAN_S + 40.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    sweep(scope_of(lab), None, {"source.bias": ["4.2 V", "10 V"]})
    assert lab.at_volt == ["4.2", "10"]
    assert lab.targets == ["10", "10", "4.2"]


class TipLab(SourceLab):
    """Notes where the tip is at each new target and each scan; a scan of a withdrawn tip is refused."""

    def __init__(self) -> None:
        super().__init__()
        self.is_engaged = True
        self.noted: list[str] = []
        self.publish(TipStatus(engaged=True))

    def execute(self, request: Request) -> Response:
        subject = request.subject
        self.values[names.ENGAGED] = "true" if self.is_engaged else "false"
        if isinstance(subject, Parameter) and subject.name == "source.bias" and subject.value is not None:
            self.noted.append(f"{subject.value} {'engaged' if self.is_engaged else 'withdrawn'}")
        if subject == names.START_SCAN and not self.is_engaged:
            return Response(ControlResponse.ACTION_ERROR, reason="the tip is withdrawn")
        if subject in (names.RETRACT, names.ENGAGE):
            self.is_engaged = subject == names.ENGAGE
            self.go(ScopeState.COARSE_MOTOR)
            self.at(1.0, lambda: self.go(ScopeState.FREE))
            self.at(2.0, lambda: self.publish(TipStatus(engaged=self.is_engaged)))
            self.executed.append(request.id)
            return Response(ControlResponse.SUCCESS)
        return super().execute(request)

    def finish_scan(self) -> None:
        self.noted.append("scan")
        super().finish_scan()


def temperatures(scope: Scope) -> list[Any]:
    with scope.sweep(BIASES, shape=(8, 8), key="series", withdraw=True) as points:
        return list(points)


WITHDRAWN_EACH_TIME = ["scan", "scan", "10 withdrawn", "scan", "scan", "4.2 withdrawn"]


def test_tip_is_withdrawn_while_an_instrument_goes_to_its_target_and_stays_so_at_the_end() -> None:
    lab = TipLab()
    temperatures(scope_of(lab))
    assert lab.noted == WITHDRAWN_EACH_TIME
    assert not lab.is_engaged


def test_killed_at_any_step_the_tip_is_withdrawn_at_each_target_and_back_for_each_scan() -> None:
    for deadly_call in range(1, 1000, 3):
        lab = TipLab()
        with TemporaryDirectory() as folder:
            try:
                temperatures(scope_of(lab, Path(folder), 0, LabPort(lab, deadly_call)))
                break
            except Kill9:
                pass
            lab.restart_component()
            lab.publish(TipStatus(engaged=lab.is_engaged))
            assert len(temperatures(scope_of(lab, Path(folder), 1))) == 4, deadly_call
        if lab.noted[-2:] == 2 * lab.noted[-1:]:  # killed after the answer: the former target is set once more
            lab.noted.pop()
        assert lab.noted == WITHDRAWN_EACH_TIME, f"killed at call {deadly_call}"
    assert deadly_call > 40


def test_tip_that_another_had_withdrawn_is_not_brought_to_the_sample() -> None:
    lab = TipLab()
    lab.is_engaged = False
    with (
        pytest.raises(Refused, match="withdrawn already, and not by this sweep"),
        scope_of(lab).sweep({"source.bias": ["10 V"]}, shape=(8, 8), withdraw=True) as points,
    ):
        list(points)
    assert not lab.is_engaged
    assert lab.noted == []


@pytest.mark.parametrize("at_s", [0.5, 1.5, 2.5, 3.5, 4.5, 6.0])
def test_no_instrument_moves_with_the_tip_at_the_sample_though_a_repair_brings_it_there(at_s: float) -> None:
    lab = TipLab()

    def taken_over() -> None:
        lab.flag(Problem.TIP_SHAPE_CHANGED)
        lab.is_engaged = True  # a repair brings the tip to the sample
        lab.values |= {"source.bias.target": "77", "source.bias": "77", "source.bias.busy": "false"}

    lab.at(2 * SCAN_S + at_s, taken_over)
    lab.at(2 * SCAN_S + at_s + 60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    temperatures(scope_of(lab))
    assert not any(one.endswith("engaged") for one in lab.noted), lab.noted
    assert lab.at_volt == ["4.2", "4.2", "10", "10"]
    assert not lab.is_engaged


def test_scan_outside_of_a_sweep_brings_no_tip_to_the_sample(tmp_path: Path) -> None:
    lab = TipLab()
    for deadly_call in range(60, 200):
        lab = TipLab()
        folder = tmp_path / str(deadly_call)
        with pytest.raises(Kill9):
            temperatures(scope_of(lab, folder, 0, LabPort(lab, deadly_call)))
        if not lab.is_engaged:
            break
    assert not lab.is_engaged
    lab.restart_component()
    with pytest.raises(Refused, match="the tip is withdrawn"):
        scope_of(lab, folder, 1).scan(shape=(8, 8))
    assert not lab.is_engaged


def test_withdrawal_without_an_instrument_is_refused() -> None:
    with pytest.raises(InvalidValue, match="none is swept"), scope_of(SweepLab()).sweep(SWEPT, withdraw=True) as points:
        list(points)


LOOP: dict[str, SweptValues] = {"tip-bias-voltage": ["0.1 V", "0.2 V", "0.1 V"]}
HERE = Region((0.0, 0.0), (1e-6, 1e-6))
THERE = Region((1e-6, 0.0), (1e-6, 1e-6))


def test_loop_takes_a_list_of_scans_and_spectra_at_each_point_once_over_kills() -> None:
    def loop(scope: Scope) -> list[Any]:
        places = [(0.0, 0.0), (1e-7, 0.0)]
        with scope.sweep(
            LOOP, order="listed", repeat=2, measure="both", region=[HERE, THERE], shape=(8, 8), at=places, key="loop"
        ) as points:
            return [(one.point, one.number, one.of, one.key, one.values["tip-bias-voltage"]) for one in points]

    once = loop(scope_of(SweepLab()))
    volts = [0.1, 0.1, 0.2, 0.2, 0.1, 0.1]
    assert once == [(n // 4 + 1, n + 1, 24, f"loop-{n + 1}", volts[n // 4]) for n in range(24)]
    for deadly_call in range(5, 1000, 7):
        lab = SweepLab()
        with TemporaryDirectory() as folder:
            try:
                loop(scope_of(lab, Path(folder), 0, LabPort(lab, deadly_call)))
                break
            except Kill9:
                pass
            lab.restart_component()
            assert loop(scope_of(lab, Path(folder), 1)) == once
        assert [volt for volt, _ in lab.measured] == [str(volt) for volt in volts for _ in range(4)], deadly_call
        assert len(lab.finished) == 12
        assert lab.in_force == BEFORE


def test_points_of_a_loop_are_published_with_their_numbers() -> None:
    lab = SweepLab()
    with scope_of(lab).sweep(LOOP, order="listed", shape=(8, 8)) as points:
        list(points)
    messages = [wire.decode(one.message, one.payload) for one in lab.told("MeasurementSettings")]
    assert [one.point for one in messages if isinstance(one, MeasurementSettings)] == [1, 2, 3, None]


class EsrLab(SourceLab):
    """A lock-in that reads the square of the source's voltage, wherever that is on its way."""

    def execute(self, request: Request) -> Response:
        response = super().execute(request)
        subject = request.subject
        if isinstance(subject, Parameter) and subject.name.removesuffix(".now") == "lockin.x":
            return Response(0, wire.encode(Parameter("lockin.x", repr(float(self.values["source.bias"]) ** 2), "V"))[1])
        return response

    def __init__(self) -> None:
        super().__init__()
        self.values["lockin.x"] = "0"


VOLTS = ["5 V", "6 V", "7 V", "6 V"]


def esr(scope: Scope, published: list[Any], key: str | None = "esr") -> Spectrum:
    def publish(thing: object, envelope: str | None) -> None:
        published.append(thing)

    return scope.sweep_at("source.bias", VOLTS, "lockin.x", at=(1e-7, 0.0), settle="1 s", key=key, publish=publish)


def test_sweep_at_a_place_reads_after_each_set_and_sets_back() -> None:
    lab, published = EsrLab(), list[Any]()
    spectrum = esr(scope_of(lab), published)
    assert spectrum.names == ("source.bias", "lockin.x")
    assert spectrum.values.tolist() == [[5.0, 25.0], [6.0, 36.0], [7.0, 49.0], [6.0, 36.0]]
    assert (spectrum.kind, spectrum.position_m) == ("source.bias", (1e-7, 0.0))
    conditions, same = published
    assert same is spectrum
    assert (conditions.holder, conditions.time_ns) == (lab.name, spectrum.time_ns)
    assert conditions.began_ns < spectrum.time_ns - 4 * 10**9  # four settling times
    assert lab.values["source.bias.target"] == "4.2"


def test_sweep_at_a_place_is_taken_again_after_control_was_lost() -> None:
    lab, published = EsrLab(), list[Any]()

    def taken_over() -> None:
        lab.flag(Problem.TIP_SHAPE_CHANGED)
        lab.values |= {"source.bias.target": "77", "source.bias": "77", "source.bias.busy": "false"}

    lab.at(3.5, taken_over)
    lab.at(60.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
    spectrum = esr(scope_of(lab), published)
    assert spectrum["lockin.x"].tolist() == [25.0, 36.0, 49.0, 36.0]
    assert lab.targets[:2] == ["5", "6"]
    assert lab.targets[-5:] == ["5", "6", "7", "6", "4.2"]


def test_control_lost_at_the_last_reading_spoils_the_sweep() -> None:
    lab, published = EsrLab(), list[Any]()
    lost: list[bool] = []

    def during_the_last_reading(request: Request) -> Response | str:
        reads = isinstance(request.subject, Parameter) and request.subject.name == "lockin.x.now"
        if reads and lab.targets == ["5", "6", "7", "6"] and not lost:
            lost.append(True)
            lab.flag(Problem.TIP_SHAPE_CHANGED)
            lab.values |= {"source.bias.target": "77", "source.bias": "77"}
            lab.at(30.0, lambda: lab.clear(Problem.TIP_SHAPE_CHANGED))
        return "go on"

    lab.intercept = during_the_last_reading
    assert esr(scope_of(lab), published)["lockin.x"].tolist() == [25.0, 36.0, 49.0, 36.0]
    assert lost


def test_reading_that_is_lacking_for_a_moment_is_taken_again() -> None:
    lab, refused = EsrLab(), list[str]()

    def overload(request: Request) -> Response | str:
        if isinstance(request.subject, Parameter) and request.subject.name == "lockin.x.now" and len(refused) < 3:
            refused.append("overload")
            return Response(ControlResponse.PARAM_ERROR, reason="overload")
        return "go on"

    lab.intercept = overload
    assert esr(scope_of(lab), [])["lockin.x"].tolist() == [25.0, 36.0, 49.0, 36.0]


def test_killed_at_any_step_a_sweep_at_a_place_has_one_result_and_is_set_back() -> None:
    for deadly_call in range(1, 1000, 2):
        lab, published = EsrLab(), list[Any]()
        with TemporaryDirectory() as folder:
            try:
                esr(scope_of(lab, Path(folder), 0, LabPort(lab, deadly_call)), published)
                break
            except Kill9:
                pass
            lab.restart_component()
            again = esr(scope_of(lab, Path(folder), 1), published)
            assert again["lockin.x"].tolist() == [25.0, 36.0, 49.0, 36.0], deadly_call
        spectra = [one for one in published if isinstance(one, Spectrum)]
        assert len({one.time_ns for one in spectra}) == 1, deadly_call
        assert lab.values["source.bias.target"] == "4.2", deadly_call
    assert deadly_call > 30


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"values": ["on", "off"]}, "numbers"),
        ({"read": []}, "set and read"),
        ({"read": ["source.bias"]}, "set and read"),
        ({"settle": "-1 s"}, "settling time"),
    ],
)
def test_sweep_at_a_place_without_sense_is_refused(given: dict[str, Any], why: str) -> None:
    with pytest.raises(InvalidValue, match=why):
        scope_of(EsrLab()).sweep_at(**({"parameter": "source.bias", "values": VOLTS, "read": ["lockin.x"]} | given))


# reports B4
def test_settling_time_is_stated_with_each_point_and_block() -> None:
    lab = SweepLab()
    scope = scope_of(lab)
    with scope.sweep(TWO_POINTS, shape=(8, 8), settle="2 s") as points:
        list(points)
    with scope.settings({"zctrl-igain": 3}, settle="500 ms"), scope.settings({"tip-bias-voltage": "1 V"}):
        scope.scan(shape=(8, 8))
    assert [one.subject.settle_s for one in lab.requests if one.kind == LEND_REQUEST] == [2.0, 2.0, 0.5]


def test_blocks_hold_together_and_the_inner_one_comes_first() -> None:
    lab = SweepLab()
    scope = scope_of(lab)
    with scope.settings({"zctrl-igain": 3, "tip-bias-voltage": "0.2 V"}):
        for _ in range(3):
            with scope.settings({"tip-bias-voltage": "0.3 V"}):
                scope.scan(shape=(8, 8))
        scope.scan(shape=(8, 8), settings={"zctrl-igain": 4})
        scope.scan(shape=(8, 8))
    assert lab.measured == [*[("0.3", "3")] * 3, ("0.2", "4"), ("0.2", "3")]
    assert lab.in_force == BEFORE
    returned = [tuple(p.name for p in one.subject.parameters) for one in lab.requests if one.kind == RETURN_REQUEST]
    assert returned == [("tip-bias-voltage", "zctrl-igain")], "what an outer block states is not given back"


def test_measurement_without_settings_withdraws_those_of_the_one_before_from_the_record() -> None:
    lab = SweepLab()
    scope = scope_of(lab)
    scope.scan(shape=(8, 8), settings={"zctrl-igain": 4})
    for _ in range(2):
        scope.scan(shape=(8, 8))
    messages = [wire.decode(one.message, one.payload) for one in lab.told("MeasurementSettings")]
    assert [tuple(p.value for p in one.parameters) for one in messages] == [("4",), ()]


def test_setting_of_another_instrument_is_no_setting_of_a_measurement() -> None:
    with pytest.raises(InvalidValue, match=r"cryo\.temperature belongs to another instrument"):
        scope_of(SweepLab()).scan(settings={"cryo.temperature": "4 K"})


def test_key_of_a_scan_with_other_settings_is_refused_and_those_of_a_block_are_free(tmp_path: Path) -> None:
    lab = SweepLab()
    scope = scope_of(lab, tmp_path)
    scope.scan(shape=(8, 8), key="one", settings={"zctrl-igain": 3})
    with pytest.raises(InvalidValue, match="was used for another measurement"):
        scope.scan(shape=(8, 8), key="one", settings={"zctrl-igain": 4})
    with scope.settings({"tip-bias-voltage": "1 V"}):
        scope.scan(shape=(8, 8), key="one", settings={"zctrl-igain": 3})
    assert len(lab.measured) == 1


def test_settings_are_stated_again_when_they_are_not_in_force_any_more() -> None:
    lab = SweepLab()
    refused: list[str] = []

    def once(request: Request) -> Response | str:
        if request.subject != names.START_SCAN or refused:
            return "go on"
        refused.append(request.id)
        detail = ResponseDetail.STATE_AGAIN
        return Response(ControlResponse.NOT_FREE, reason="the bias was 0.7 V", id=request.id, detail=detail)

    lab.intercept = once
    scope_of(lab).scan(shape=(8, 8), settings={"tip-bias-voltage": "0.2 V"})
    assert lab.count(LEND_REQUEST) == 2
    assert lab.measured == [("0.2", "7")]
    assert lab.clock.passed_s < SCAN_S + 10.0, "at once"


def test_what_was_stated_for_a_measurement_that_did_not_begin_does_not_hold_for_the_next() -> None:
    lab = SweepLab()
    lab.intercept = lambda request: (
        Response(ControlResponse.ACTION_ERROR, reason="no tip") if request.subject == names.START_SCAN else "go on"
    )
    scope = scope_of(lab)
    with scope.control():
        with pytest.raises(Refused):
            scope.scan(shape=(8, 8), settings={"tip-bias-voltage": "0.2 V"})
        lab.intercept = lambda request: "go on"
        scope.scan(shape=(8, 8))
    assert [len(one.subject.settings) for one in lab.requests if one.kind == LEND_REQUEST] == [1, 0]
