"""The simulated instrument of all emulators."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import InvalidValue
from afspm.basics.plain_data import Plain
from afspm.model import Region
from afspm.simulation import World
from afspm.simulation.background import in_background
from afspm.simulation.instrument import InstrumentBusy, SimulatedInstrument
from afspm.simulation.scan_drawing import run_at_once


def test_scan_takes_its_time_and_its_lines_appear_one_by_one(rig: SimulatedInstrument, clock: Any) -> None:
    scan = rig.start_scan(clock.t_s)
    assert scan.end_s == 1004.0
    told = []
    for t_s in (1000.0, 1000.49, 1000.5, 1002.0, 1003.99, 1004.0):
        clock.t_s = t_s
        told.append((scan.lines_done(t_s), rig.doing(t_s)))
    assert told == [(0, "scan"), (0, "scan"), (1, "scan"), (4, "scan"), (7, "scan"), (8, "")]
    assert rig.scan is scan


def test_lines_not_yet_scanned_are_missing(rig: SimulatedInstrument) -> None:
    rig.setup.upwards = False
    scan = rig.start_scan(1000.0)
    unit, height = scan.channels(1001.0)["Height"]
    assert unit == "m"
    assert np.isnan(height[:6]).all()
    assert np.isfinite(height[6:]).all()
    assert np.array_equal(scan.channels()["Height"][1][6:], height[6:])


def test_instrument_has_the_world_of_the_simulator(rig: SimulatedInstrument) -> None:
    theirs = World.from_settings({}, 3, 1000.0).scan(rig.setup.region, (8, 16), 0.5, 1000.0, rig.setup.feedback, 0.1)
    ours = rig.start_scan(1000.0)
    assert np.array_equal(ours.channels()["Height"][1], theirs.channels()["Height"][1])


def test_changes_during_a_scan_hold_for_the_next(rig: SimulatedInstrument) -> None:
    scan = rig.start_scan(1000.0)
    rig.setup.region, rig.setup.shape = Region((1e-6, 0.0), (2e-6, 1e-6)), (4, 4)
    assert scan.region == Region((0.0, 0.0), (1e-6, 1e-6))
    assert scan.channels()["Height"][1].shape == (8, 16)


def test_stopped_scan_keeps_its_lines(rig: SimulatedInstrument, clock: Any) -> None:
    scan = rig.start_scan(clock.t_s)
    clock.t_s = 1001.2
    rig.stop_scan(clock.t_s)
    clock.t_s = 1100.0
    assert (scan.stopped_s, scan.lines_done(1100.0), rig.busy(1100.0)) == (1001.2, 2, False)
    assert np.isnan(scan.channels(1100.0)["Height"][1]).all(axis=1).tolist() == [False] * 2 + [True] * 6


def test_stopping_a_scan_that_is_over_changes_nothing(rig: SimulatedInstrument, clock: Any) -> None:
    scan = rig.start_scan(clock.t_s)
    clock.t_s = 1010.0
    rig.stop_scan(clock.t_s)
    assert (scan.stopped_s, scan.end_s, scan.lines_done(1010.0)) == (None, 1004.0, 8)


def test_pause_postpones_the_end(rig: SimulatedInstrument) -> None:
    scan = rig.start_scan(1000.0)
    scan.pause(1001.0)
    assert scan.running(1500.0)
    assert scan.lines_done(1500.0) == 2
    assert rig.next_change_s(1500.0) is None
    scan.resume(1501.0)
    assert (scan.end_s, scan.lines_done(1501.5)) == (1504.0, 3)
    assert np.isfinite(scan.channels(1501.5)["Height"][1]).all(axis=1).sum() == 3


def test_impossible_scan_is_refused_at_once(rig: SimulatedInstrument) -> None:
    rig.setup.line_s = 0.0
    with pytest.raises(InvalidValue, match="line"):
        rig.start_scan(1000.0)
    assert not rig.busy(1000.0)


def test_second_activity_is_refused(rig: SimulatedInstrument) -> None:
    rig.start_scan(1000.0)
    now_s = 1000.0
    for other in (
        lambda: rig.start_scan(now_s),
        lambda: rig.engage(now_s),
        lambda: rig.start_spectrum("IV", now_s),
        lambda: rig.move_probe((0, 0), now_s),
    ):
        with pytest.raises(InstrumentBusy, match="scan"):
            other()


@pytest.mark.parametrize(("what", "named"), [("approach", "busy with an approach"), ("pulse", "busy with a pulse")])
def test_busy_instrument_names_its_activity(rig: SimulatedInstrument, what: str, named: str) -> None:
    rig.occupy(what, 1.0, 1000.0)
    with pytest.raises(InstrumentBusy, match=named):
        rig.occupy("scan", 1.0, 1000.0)


def test_duration_of_a_move_is_proportional_to_its_length(rig: SimulatedInstrument, clock: Any) -> None:
    rig.setup.move_speed_m_s = 1e-6
    rig.move_probe((3e-6, 4e-6), clock.t_s)
    clock.t_s = 1002.5
    assert rig.probe_at(1002.5) == pytest.approx((1.5e-6, 2e-6))
    rig.move_probe((1.5e-6, 0.0), clock.t_s)  # on its way it is sent elsewhere
    assert rig.next_change_s(1002.5) == pytest.approx(1004.5)
    assert rig.probe_at(1005.0) == (1.5e-6, 0.0)
    assert not rig.busy(1005.0)


def test_move_can_be_stopped_on_the_way(rig: SimulatedInstrument, clock: Any) -> None:
    rig.setup.move_speed_m_s = 1e-6
    rig.move_probe((4e-6, 0.0), clock.t_s)
    clock.t_s = 1001.0
    rig.stop_move(clock.t_s)
    assert rig.probe_m == pytest.approx((1e-6, 0.0))
    assert not rig.busy(1001.0)


def test_spectrum_is_taken_where_the_probe_is(rig: SimulatedInstrument, clock: Any) -> None:
    rig.move_probe((1e-7, 0.0), clock.t_s)
    clock.t_s += 1.0
    spectrum = rig.start_spectrum("IV", clock.t_s)
    assert spectrum.position_m == (1e-7, 0.0)
    assert spectrum.values.shape == (256, len(spectrum.names))
    assert rig.doing(1002.9) == "spectrum"
    assert not rig.busy(spectrum.end_s)
    assert spectrum.end_s == 1003.0


def test_in_air_every_measurement_is_noise(rig: SimulatedInstrument, clock: Any) -> None:
    rig.withdraw(clock.t_s)
    assert rig.doing(1000.5) == "approach"
    clock.t_s = 1001.0
    in_air = rig.start_scan(clock.t_s)
    assert in_air.channels().keys() == rig.channels.keys()
    assert np.abs(in_air.channels()["Height"][1]).max() < 1e-10
    assert np.isnan(in_air.channels(1003.0)["Height"][1]).all(axis=1).tolist() == [False] * 4 + [True] * 4
    clock.t_s = 1100.0
    curve = rig.start_spectrum("IV", clock.t_s)
    assert np.ptp(curve.values[:, 0]) == pytest.approx(3.0)  # the sweep goes on
    assert np.abs(curve.values[:, 1]).max() < 1e-13
    clock.t_s = 1200.0
    rig.engage(clock.t_s)
    clock.t_s = 1300.0
    assert np.ptp(rig.start_scan(clock.t_s).channels()["Height"][1]) > 1e-10


def test_withdrawing_ends_any_activity(rig: SimulatedInstrument, clock: Any) -> None:
    scan = rig.start_scan(clock.t_s)
    clock.t_s = 1001.0
    rig.withdraw(clock.t_s)
    assert scan.stopped_s == 1001.0
    assert rig.doing(1001.5) == "approach"


def test_tip_moves_forward_and_back_along_a_turned_line(rig: SimulatedInstrument) -> None:
    rig.setup.region = Region((1e-6, 2e-6), (2e-6, 1e-6), math.pi / 2)
    rig.start_scan(1000.0)
    # turned by 90 degrees the fast axis runs along +y, the slow one along -x
    assert rig.probe_at(1000.0) == pytest.approx((1.5e-6, 1e-6))
    assert rig.probe_at(1000.25) == pytest.approx((1.5e-6, 3e-6))
    assert rig.probe_at(1003.75) == pytest.approx((0.5e-6, 3e-6))


def last_mark(rig: SimulatedInstrument, t_s: float) -> dict[str, Any]:
    truth: dict[str, Any] = rig.world.truth(t_s)
    mark: dict[str, Any] = truth["marks"][-1]
    return mark


def test_pulses_and_crashes_change_the_world(rig: SimulatedInstrument, clock: Any) -> None:
    assert rig.pulse(8.0, 0.1, clock.t_s) in ("cured", "worsened", "unchanged")
    clock.t_s = 1001.0
    rig.crash(depth_m=1e-7, speed_m_s=1e-6, now_s=clock.t_s)
    assert rig.next_change_s(1001.0) == pytest.approx(1001.2)
    clock.t_s = 1002.0
    deep = last_mark(rig, 1002.0)
    rig.crash(depth_m=1e-9, speed_m_s=1e-6, now_s=clock.t_s)
    shallow = last_mark(rig, 1003.0)
    assert [mark["kind"] for mark in (deep, shallow)] == ["crash", "crash"]
    assert shallow["depth_m"] < 1e-9 < deep["depth_m"]


def test_scan_computed_in_the_background_is_the_same_and_wakes_the_emulator(clock: Any) -> None:
    woken = []
    at_once, meanwhile = (SimulatedInstrument({}, 3, clock.t_s, run=run) for run in (run_at_once, in_background))
    meanwhile.drawing.wake = lambda: woken.append(True)
    heights = []
    for rig in (at_once, meanwhile):
        rig.setup.shape = (8, 16)
        heights.append(rig.start_scan(clock.t_s).channels()["Height"][1])
    assert np.array_equal(heights[0], heights[1])
    meanwhile.stop_scan(clock.t_s)
    meanwhile.start_scan(clock.t_s).channels()
    assert woken


def test_scanner_follows_the_sample_at_the_set_velocity(rig: SimulatedInstrument, clock: Any) -> None:
    rig.start_scan(clock.t_s)
    rig.follow((2e-9, -1e-9), clock.t_s)
    clock.t_s = 1100.0
    ours = rig.start_scan(clock.t_s).channels()["Height"][1]
    world = World.from_settings({}, 3, 1000.0)
    world.scan(rig.setup.region, (8, 16), 0.5, 1000.0, rig.setup.feedback, 0.1)
    world.compensate((2e-9, -1e-9), 1000.0)
    theirs = world.scan(rig.setup.region, (8, 16), 0.5, 1100.0, rig.setup.feedback, 0.1)
    assert np.array_equal(ours, theirs.channels()["Height"][1])
    world.compensate((0.0, 0.0), 1200.0)
    elsewhere = world.scan(rig.setup.region, (8, 16), 0.5, 1300.0, rig.setup.feedback, 0.1).channels()["Height"][1]
    assert np.corrcoef(ours.ravel(), elsewhere.ravel())[0, 1] < 0.999


def test_tip_at_rest_shows_the_value_of_a_scan_without_changing_the_world(rig: SimulatedInstrument, clock: Any) -> None:
    rig.setup.region, rig.setup.shape = Region((30e-9, -20e-9), (10e-9, 10e-9)), (9, 9)
    rig.move_probe((30e-9, -20e-9), clock.t_s)
    clock.t_s += 10.0
    shown = [rig.signals(clock.t_s) for _ in range(20)]
    scanned = rig.start_scan(clock.t_s).channels()
    looked_at = {name: np.array([signals[name] for signals in shown]) for name in shown[0]}
    assert set(looked_at) == {name for name in scanned if not name.endswith("Retrace")}
    for name, values in looked_at.items():
        assert len(set(values)) == 20, "it has noise"
        near = scanned[name][1][3:6, 3:6]
        assert abs(values.mean() - near.mean()) < 5 * near.std() + 3 * values.std()
    unseen = World.from_settings({}, 3, 1000.0)
    unseen.move_to((30e-9, -20e-9), 1000.0 + math.hypot(30e-9, 20e-9) / rig.setup.move_speed_m_s)
    unseen.scan(rig.setup.region, (9, 9), 0.5, clock.t_s, rig.setup.feedback, 0.1)
    assert rig.world.state() == unseen.state()


def test_signals_follow_the_lines_of_a_scan_and_are_noise_without_a_sample(
    rig: SimulatedInstrument, clock: Any
) -> None:
    scan = rig.start_scan(clock.t_s)
    picture = scan.channels()
    clock.t_s = scan.start_s + 2 * rig.setup.line_s + rig.setup.line_s * 0.25 * 1.01
    assert rig.signals(clock.t_s)["Height"] == picture["Height"][1][2, 8]
    clock.t_s = scan.start_s + 2 * rig.setup.line_s + rig.setup.line_s * 0.999
    assert rig.signals(clock.t_s)["Height"] == picture["Height Retrace"][1][2, 0]
    rig.setup.feedback = replace(rig.setup.feedback, setpoint=-1.0)
    clock.t_s = scan.end_s + 1.0
    assert abs(rig.signals(clock.t_s)["Current"]) < 1e-13, "no feedback, no contact"
    rig.withdraw(clock.t_s)
    assert abs(rig.signals(clock.t_s)["Current"]) < 1e-13


def test_with_the_feedback_off_the_current_follows_where_z_is_held(clock: Any) -> None:
    rig = SimulatedInstrument({"feedback": {"mode": "current", "setpoint": 1e-10}}, 3, clock.t_s)
    z_m = np.mean([rig.signals(clock.t_s)["Height"] for _ in range(50)])
    rig.setup.feedback = replace(rig.setup.feedback, on=False)
    rig.hold(float(z_m))
    at = float(np.mean([rig.signals(clock.t_s)["Current"] for _ in range(50)]))
    rig.hold(float(z_m) + 0.1e-9)
    above = float(np.mean([rig.signals(clock.t_s)["Current"] for _ in range(50)]))
    decay_m = rig.world.settings.feedback.decay_m
    assert np.log(at / above) == pytest.approx(0.1e-9 / decay_m, abs=0.3)


@pytest.fixture
def sensor(clock: Any) -> SimulatedInstrument:
    """An instrument with an oscillating sensor, on flat ground."""
    settings = {"feedback": {"mode": "frequency-shift", "setpoint": -20.0}, "noise": {"scar_probability": 0.0}}
    rig = SimulatedInstrument(settings, 3, clock.t_s)
    rig.setup.region, rig.setup.shape = Region((30e-9, -20e-9), (10e-9, 10e-9)), (9, 9)
    rig.move_probe((30e-9, -20e-9), clock.t_s)
    clock.t_s += 10.0
    return rig


def _shift_hz(rig: SimulatedInstrument, clock: Any) -> float:
    return float(np.mean([rig.signals(clock.t_s)["Frequency Shift"] for _ in range(100)]))


def test_sensor_at_rest_shows_the_frequency_shift_of_the_picture_and_of_the_setpoint(
    sensor: SimulatedInstrument, clock: Any
) -> None:
    for setpoint_hz in (-20.0, -5.0):
        sensor.setup.feedback = replace(sensor.setup.feedback, setpoint=setpoint_hz)
        unit, picture_hz = sensor.start_scan(clock.t_s).channels()["Frequency Shift"]
        clock.t_s += 100.0
        assert unit == "Hz"
        assert _shift_hz(sensor, clock) == pytest.approx(setpoint_hz, abs=0.05)
        assert np.median(picture_hz) == pytest.approx(setpoint_hz, abs=0.2)


def test_lifted_sensor_shows_the_remaining_attraction(sensor: SimulatedInstrument, clock: Any) -> None:
    z_m = float(np.mean([sensor.signals(clock.t_s)["Height"] for _ in range(400)]))
    sensor.setup.feedback = replace(sensor.setup.feedback, on=False)
    shifts_hz = []
    for lift_m in (0.0, 1e-9, 1e-6):
        sensor.hold(z_m + lift_m)
        shifts_hz.append(_shift_hz(sensor, clock))
    physics = sensor.world.settings.feedback.sensor
    lifted_hz = float(physics.shift_hz(np.array(physics.distance_m(-20.0) + 1e-9)))
    assert shifts_hz == [pytest.approx(-20.0, abs=0.5), pytest.approx(lifted_hz, abs=0.3), pytest.approx(0.0, abs=0.05)]
    sensor.withdraw(clock.t_s)
    assert _shift_hz(sensor, clock) == pytest.approx(0.0, abs=0.05)


def test_scan_that_can_not_be_simulated_is_interrupted(
    rig: SimulatedInstrument, clock: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = SimulatedInstrument({}, 3, clock.t_s)
    rig.setup.shape = (16, 16)

    def fails(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr(rig.world, "scan", fails)
    scan = rig.start_scan(clock.t_s)
    picture = scan.channels()
    assert (scan.stopped_s, scan.running(clock.t_s), rig.busy(clock.t_s)) == (scan.start_s, False, False)
    assert set(picture) == set(rig.channels)
    assert np.isnan(picture["Height"][1]).all()
    assert "was stopped" in caplog.text


def test_invalid_setup_is_refused_before_any_activity(rig: SimulatedInstrument, clock: Any) -> None:
    for change in (
        {"feedback": replace(rig.setup.feedback, setpoint=-1.0)},
        {"feedback": replace(rig.setup.feedback, integral_gain=-1.0)},
        {"slope": (math.nan, 0.0)},
        {"bias_v": math.inf},
        {"line_s": 0.0},
        {"line_s": 1e-300},
        {"region": Region((0.0, 0.0), (1e-38, 1e-6))},
        {"region": Region((0.0, 0.0), (1.0, 1.0))},
        {"region": Region((0.0, 0.0), (1e-11, 1e-4))},
        {"region": Region((0.0, -3e38), (1e-6, 1e-6))},  # faults 18: its cells overflow
    ):
        before = {name: getattr(rig.setup, name) for name in change}
        for name, value in change.items():
            setattr(rig.setup, name, value)
        with pytest.raises(InvalidValue):
            rig.start_scan(clock.t_s)
        for name, value in before.items():
            setattr(rig.setup, name, value)
    rig.engaged = False
    for begin in (
        lambda: rig.move_probe((0.0, math.nan), clock.t_s),
        lambda: rig.move_probe((3e38, 0.0), clock.t_s),  # faults 18
        lambda: rig.pulse(1.0, math.nan, clock.t_s),
        lambda: rig.crash(1e-9, 0.0, clock.t_s),
        lambda: rig.follow((1.0, 0.0), clock.t_s),
        lambda: rig.hold(math.inf),
    ):
        with pytest.raises(InvalidValue):
            begin()
    assert not rig.busy(clock.t_s)
    assert rig.scan is None


def _kept(rig: SimulatedInstrument) -> Any:
    return json.loads(json.dumps(rig.state()))


def _killed(rig: SimulatedInstrument) -> SimulatedInstrument:
    again = SimulatedInstrument({}, 3, 1000.0)
    again.setup = rig.setup
    again.restore(_kept(rig))
    return again


def test_killed_instrument_continues_its_scan_identically(rig: SimulatedInstrument) -> None:
    rig.pulse(8.0, 0.1, 1000.0)
    rig.start_scan(1001.0)
    again = _killed(rig)
    assert (again.doing(1002.0), again.probe_at(1002.0)) == ("scan", rig.probe_at(1002.0))
    for instrument in (rig, again):
        ended = instrument.ended(1010.0)
        assert ended is instrument.scan
        assert instrument.ended(1010.0) is None
    assert rig.scan is not None
    assert again.scan is not None
    assert np.array_equal(rig.scan.channels()["Height"][1], again.scan.channels()["Height"][1])
    for instrument in (rig, again):
        instrument.start_scan(1020.0)
    assert (rig.scan.number, again.scan.number) == (2, 2)
    assert np.array_equal(rig.scan.channels()["Height"][1], again.scan.channels()["Height"][1])
    assert _kept(rig) == _kept(again)


def test_killed_instrument_continues_its_activity(rig: SimulatedInstrument) -> None:
    for now_s, begin, what in (
        (1000.0, lambda at_s: rig.move_probe((3e-6, 0.0), at_s), "move"),
        (1010.0, lambda at_s: rig.start_spectrum("force", at_s), "spectrum"),
        (1020.0, rig.withdraw, "approach"),
    ):
        begin(now_s)
        again = _killed(rig)
        assert (again.doing(now_s), again.ends_s, again.engaged) == (what, rig.ends_s, rig.engaged)
        assert again.probe_at(now_s) == rig.probe_at(now_s)
        if what == "spectrum":
            assert np.array_equal(rig.spectrum.values, again.spectrum.values)  # type: ignore[union-attr]


def test_velocity_set_during_a_scan_affects_the_rest_and_survives_a_kill(rig: SimulatedInstrument) -> None:
    rig.setup.upwards = True
    before = rig.start_scan(1000.0).channels()["Height"][1]
    rig.follow((1e-7, 0.0), 1002.0)  # after four of eight lines
    again = _killed(rig)
    for instrument in (rig, again):
        assert instrument.scan is not None
        after = instrument.scan.channels()["Height"][1]
        change_m = np.abs(after - before)
        assert change_m[:3].max() < 0.1 * change_m[5:].max()
    assert rig.world.sample.compensation.at(1100.0)[0] == pytest.approx(again.world.sample.compensation.at(1100.0)[0])


def test_feedback_set_during_a_scan_is_in_force_from_the_next_line_on(rig: SimulatedInstrument) -> None:
    before = rig.start_scan(1000.0).channels()["Amplitude"][1]
    rig.setup.feedback = replace(rig.setup.feedback, setpoint=0.3)
    rig.adjust(1002.0)
    assert rig.scan is not None
    after = rig.scan.channels()["Amplitude"][1]
    assert np.array_equal(before[:4], after[:4])
    assert np.median(after[4:]) == pytest.approx(0.3, abs=0.05)
    assert np.median(before[4:]) == pytest.approx(0.7, abs=0.05)


def test_setup_of_a_scan_and_place_of_a_spectrum_are_noted(clock: Any) -> None:
    noted: dict[str, Mapping[str, Any]] = {}
    rig = SimulatedInstrument({}, 3, clock.t_s, note=lambda _, event, facts: noted.update({event: facts}))
    rig.setup.region, rig.setup.shape, rig.setup.line_s = Region((1e-7, 2e-7), (3e-7, 4e-7), 0.5), (4, 6), 0.25
    rig.setup.feedback = replace(rig.setup.feedback, integral_gain=77.0)
    rig.start_scan(1000.0)
    rig.stop_scan(1001.0)
    rig.move_probe((5e-8, -6e-8), 1002.0)
    rig.start_spectrum("force", 1003.0)
    setup, curve = noted["scan starts"]["setup"], noted["spectrum starts"]
    assert (setup["center_m"], setup["size_m"], setup["angle_rad"]) == ((1e-7, 2e-7), (3e-7, 4e-7), 0.5)
    assert (setup["shape"], setup["line_s"], setup["feedback"]["integral_gain"]) == ((4, 6), 0.25, 77.0)
    assert (curve["position_m"], curve["kind"]) == ((5e-8, -6e-8), "force")


@pytest.mark.parametrize("is_restored", [False, True])
def test_tip_changes_in_the_scan_with_a_number(clock: Any, *, is_restored: bool) -> None:
    settings: Plain = {"tip_changes": {"in_scans": [[2, "double"], [3.5, "blunt"]]}}
    noted: list[Any] = []

    def note(time_s: float, event: str, facts: Mapping[str, Any]) -> None:
        noted.extend(facts.get("changes_in_scan", ()))

    rig = SimulatedInstrument(settings, 3, clock.t_s, note=note)
    rig.setup.shape, rig.setup.line_s = (4, 4), 0.5

    def flaws_of_scan(start_s: float) -> list[tuple[float, list[str]]]:
        nonlocal rig
        scan = rig.start_scan(start_s)
        if is_restored:
            kept, setup = json.loads(json.dumps(rig.state())), rig.setup
            rig = SimulatedInstrument(settings, 3, clock.t_s, note=note)
            rig.setup = setup
            rig.restore(kept)
            assert rig.scan is not None
            scan = rig.scan
        tips: Any = scan.truth["tips"]
        rig.ended(scan.end_s)
        return [(one["t_s"] - start_s, list(one["flaws"])) for one in tips]

    assert flaws_of_scan(1000.0) == [(0.0, [])]
    assert flaws_of_scan(1010.0)[-1] == (0.0, ["double"])
    assert flaws_of_scan(1020.0) == [(0.0, ["double"]), (1.0, ["blunt", "double"])]
    assert noted == [(1010.0, "double"), (1021.0, "blunt")]


def test_events_are_noted_with_the_truth(clock: Any) -> None:
    noted: list[tuple[float, str, bool]] = []

    def note(time_s: float, event: str, facts: Mapping[str, Any]) -> None:
        if event not in ("ledger", "conditions", "scan ends", "spectrum ends"):
            noted.append((time_s, event, "drift_m" in facts["truth"]))

    rig = SimulatedInstrument({}, 3, clock.t_s, note=note)
    rig.setup.shape, rig.setup.line_s = (4, 4), 0.5
    rig.start_scan(1000.0)
    rig.stop_scan(1001.0)
    rig.start_spectrum("IV", 1002.0)
    rig.stop_spectrum(1003.0)
    rig.pulse(8.0, 0.1, 1004.0)
    rig.crash(1e-9, 1e-8, 1005.0)
    events = ("scan starts", "scan stopped", "spectrum starts", "spectrum stopped", "pulse", "crash")
    assert noted == [(1000.0 + number, event, True) for number, event in enumerate(events)]


def noting(clock: Any, **world: Any) -> tuple[SimulatedInstrument, list[tuple[float, str, Any]]]:
    """Return an instrument with the list of its events, in the order of time."""
    noted: list[tuple[float, str, Any]] = []
    rig = SimulatedInstrument(world, 3, clock.t_s, note=lambda *line: noted.append(line))
    rig.setup.shape, rig.setup.line_s = (4, 4), 0.5
    return rig, noted


def facts_of(noted: list[tuple[float, str, Any]], event: str) -> list[tuple[float, Any]]:
    return [(time_s, facts) for time_s, name, facts in noted if name == event]


def test_conditions_of_a_scan_are_noted_at_their_times(clock: Any) -> None:
    rig, noted = noting(clock)
    rig.start_scan(1000.0)
    rig.switch_feedback(1000.5, on=False)
    rig.setup.bias_v = 0.25
    rig.note_changes(1001.0)
    rig.note_changes(1001.5)
    rig.account(1002.5)
    rig.withdraw(1003.0)
    conditions = facts_of(noted, "conditions")
    assert [
        (time_s, one["engaged"], one["held"], one["feedback"]["on"], one["bias_v"]) for time_s, one in conditions
    ] == [
        (1000.0, True, False, True, 0.1),
        (1000.5, True, False, False, 0.1),
        (1001.0, True, False, False, 0.25),
        (1003.0, False, False, False, 0.25),
    ]
    assert conditions[0][1]["feedback"] == {
        "on": True, "proportional_gain": 0.1, "integral_gain": 1500.0, "setpoint": 0.7,
    }  # fmt: skip
    assert facts_of(noted, "scan ends") == [(1002.0, {"number": 1, "stopped": False, "lines": 4})]
    names = [name for _, name, _ in noted]
    assert names.index("conditions") < names.index("scan starts"), "the conditions at its start are known"


def test_end_of_a_stopped_measurement_is_noted_once(clock: Any) -> None:
    rig, noted = noting(clock)
    rig.start_scan(1000.0)
    rig.stop_scan(1001.2)
    rig.start_spectrum("IV", 1002.0)
    rig.stop_spectrum(1003.0)
    rig.start_spectrum("IV", 1004.0)
    rig.account(1010.0)
    rig.account(1011.0)
    assert facts_of(noted, "scan ends") == [(1001.2, {"number": 1, "stopped": True, "lines": 2})]
    assert facts_of(noted, "spectrum ends") == [
        (1003.0, {"number": 1, "stopped": True}),
        (1006.0, {"number": 2, "stopped": False}),
    ]


def test_end_of_a_scan_after_a_kill_is_noted(clock: Any) -> None:
    rig, _ = noting(clock)
    rig.start_scan(1000.0)
    kept = json.loads(json.dumps(rig.state()))
    again, noted = noting(clock)
    again.restore(kept)
    again.account(1010.0)
    assert facts_of(noted, "scan ends") == [(1002.0, {"number": 1, "stopped": False, "lines": 4})]
    assert len(facts_of(noted, "conditions")) == 1
