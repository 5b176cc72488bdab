"""The z feedback that a controller holds in a spectrum, and gives back some time after its reported end."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from afspm.basics.errors import ConfigError
from afspm.simulation import World
from afspm.simulation.instrument import SimulatedInstrument

START_S = 1000.0
DELAYS_S = pytest.mark.parametrize("hold_s", [0.0, 0.05, 0.3])


class Bench:
    """An instrument with the lines of its ground truth."""

    def __init__(self, **feedback: Any) -> None:
        noise = {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}
        self.settings = {"feedback": feedback, "noise": noise}
        self.lines: list[tuple[float, str, Any]] = []
        self.rig = self.made()

    def made(self) -> SimulatedInstrument:
        rig = SimulatedInstrument(self.settings, seed=3, start_s=START_S, note=self._note)
        rig.setup.shape, rig.setup.line_s = (8, 16), 0.1
        return rig

    def _note(self, time_s: float, event: str, facts: Mapping[str, object]) -> None:
        self.lines.append((time_s, event, facts))

    def restarted(self) -> SimulatedInstrument:
        kept, setup = json.loads(json.dumps(self.rig.state())), self.rig.setup
        self.rig = self.made()
        self.rig.setup = setup
        self.rig.restore(kept)
        return self.rig


@DELAYS_S
@pytest.mark.parametrize("reads", ["off", "on"])
def test_feedback_is_held_until_some_time_after_the_end_of_a_spectrum(hold_s: float, reads: str) -> None:
    rig = Bench(hold_s=hold_s, hold_reads=reads).rig
    assert (rig.is_held(START_S), rig.feedback_reads(START_S)) == (False, True)
    end_s = rig.start_spectrum("IV", START_S).end_s
    for t_s in (START_S, end_s - 1e-3, end_s + hold_s - 1e-3):
        assert (rig.is_held(t_s), rig.feedback_reads(t_s)) == (True, reads == "on"), t_s
    assert not rig.busy(end_s)
    assert rig.next_change_s(end_s) == (end_s + hold_s if hold_s else None)
    assert (rig.is_held(end_s + hold_s), rig.feedback_reads(end_s + hold_s)) == (False, True)
    assert rig.setup.feedback.on is True


@DELAYS_S
def test_stopped_spectrum_gives_the_feedback_back(hold_s: float) -> None:
    rig = Bench(hold_s=hold_s).rig
    rig.start_spectrum("IV", START_S)
    rig.stop_spectrum(START_S + 0.5)
    assert rig.is_held(START_S + 0.5) is (hold_s > 0.0)
    assert rig.feedback_reads(START_S + 0.5 + hold_s)


def test_feedback_that_a_person_switches_off_meanwhile_stays_off() -> None:
    rig = Bench(hold_s=0.3, hold_reads="on").rig
    end_s = rig.start_spectrum("IV", START_S).end_s
    rig.switch_feedback(end_s + 0.1, on=False)
    for t_s in (end_s + 0.1, end_s + 10.0):
        assert (rig.is_held(t_s), rig.feedback_reads(t_s)) == (False, False)
    rig.start_spectrum("IV", end_s + 10.0)
    assert not rig.is_held(end_s + 10.0), "a feedback that is off is not held"


def test_withdrawn_tip_has_no_held_feedback() -> None:
    rig = Bench(hold_s=0.3).rig
    rig.start_spectrum("IV", START_S)
    rig.withdraw(START_S + 0.5)
    rig.engage(START_S + 1.5)
    assert not rig.is_held(START_S + 1.6)


@pytest.mark.parametrize("after_s", [-0.5, 0.1])
def test_hold_survives_a_kill(after_s: float) -> None:
    bench = Bench(hold_s=0.3)
    end_s = bench.rig.start_spectrum("IV", START_S).end_s
    killed_s = end_s + after_s
    bench.rig.ended(killed_s)
    rig = bench.restarted()
    assert (rig.is_held(killed_s), rig.is_held(end_s + 0.29), rig.is_held(end_s + 0.3)) == (True, True, False)


def test_hold_is_no_danger_and_a_switch_is() -> None:
    rig = Bench(hold_s=0.3).rig
    end_s = rig.start_spectrum("IV", START_S).end_s
    rig.account(end_s + 10.0)
    assert rig.ledger.feedback_off_s == 0.0
    end_s = rig.start_spectrum("IV", end_s + 10.0).end_s
    rig.switch_feedback(end_s - 0.5, on=False)
    rig.account(end_s + 1.0)
    assert rig.ledger.feedback_off_s == pytest.approx(1.5)


def test_scan_begun_during_the_hold_has_its_first_lines_without_feedback() -> None:
    held, free = Bench(hold_s=0.3), Bench()
    for rig in (held.rig, free.rig):
        rig.move_probe((0.2e-6, 0.1e-6), START_S - 1.0)
        end_s = rig.start_spectrum("IV", START_S).end_s
    begin_s = end_s + 0.01
    lines = held.rig.start_scan(begin_s).channels()["Height"][1]
    expected = free.rig.start_scan(begin_s).channels()["Height"][1]
    assert np.ptp(lines[:3], axis=1) == pytest.approx(0.0, abs=1e-9), "3 lines of 0.1 s in 0.29 s"
    assert np.ptp(expected[:3]) > 1.5e-9
    assert np.array_equal(lines[3:], expected[3:])
    scan = held.rig.scan
    assert scan is not None
    assert (scan.feedback.on, [one.feedback.on for one in scan.adjusted]) == (False, [True])
    held.restarted()
    assert held.rig.scan is not None
    assert np.array_equal(held.rig.scan.channels()["Height"][1], lines)


@pytest.mark.parametrize("is_off", [True, False])
def test_change_in_a_scan_during_the_hold(*, is_off: bool) -> None:
    rig = Bench(hold_s=0.3).rig
    end_s = rig.start_spectrum("IV", START_S).end_s
    scan = rig.start_scan(end_s)
    if is_off:
        rig.switch_feedback(end_s + 0.1, on=False)
    else:
        rig.setup.bias_v = 0.2
    rig.adjust(end_s + 0.1)
    flat = np.ptp(scan.channels()["Height"][1], axis=1) < 1e-9
    assert flat.tolist() == [True] * 3 + [is_off] * 5


@DELAYS_S
def test_hold_is_noted_with_its_times(hold_s: float) -> None:
    bench = Bench(hold_s=hold_s)
    end_s = bench.rig.start_spectrum("IV", START_S).end_s
    bench.rig.account(end_s + 1.0)
    told = [(time_s, event, facts.get("held")) for time_s, event, facts in bench.lines]
    assert told == [
        (START_S, "conditions", False),
        (START_S, "spectrum starts", None),
        (START_S, "conditions", True),
        (end_s, "spectrum ends", None),
        (end_s + hold_s, "conditions", False),
    ]


def test_switch_during_the_hold_ends_it_in_the_truth() -> None:
    bench = Bench(hold_s=0.3)
    end_s = bench.rig.start_spectrum("IV", START_S).end_s
    bench.rig.switch_feedback(end_s + 0.1, on=False)
    bench.rig.account(end_s + 1.0)
    conditions = [
        (time_s, one["held"], one["feedback"]["on"]) for time_s, name, one in bench.lines if name == "conditions"
    ]
    assert conditions == [(START_S, False, True), (START_S, True, True), (end_s + 0.1, False, False)]


def test_unknown_reading_of_a_held_feedback_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown: 'maybe'"):
        World.from_settings({"feedback": {"hold_reads": "maybe"}}, 1, 0.0)
