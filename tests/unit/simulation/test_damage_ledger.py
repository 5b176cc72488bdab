"""The damage ledger of the ground truth, counted by the instrument."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import pytest

from afspm.model import Region
from afspm.simulation.instrument import SimulatedInstrument
from afspm.simulation.ledger import PRESSED_FROM_M, DamageLedger, distance_m

START_S = 1000.0


class Bench:
    """An instrument with the lines of its ground truth."""

    def __init__(self, **world: object) -> None:
        self.lines: list[dict[str, Any]] = []
        self.rig = SimulatedInstrument(world, seed=3, start_s=START_S, note=self._note)
        self.rig.setup.shape, self.rig.setup.line_s = (8, 16), 0.5

    def _note(self, time_s: float, event: str, facts: Mapping[str, object]) -> None:
        self.lines.append(json.loads(json.dumps({"time_s": time_s, "event": event, **facts}, default=float)))

    def ledgers(self) -> list[dict[str, Any]]:
        return [line for line in self.lines if line["event"] == "ledger"]

    def scan(self, now_s: float) -> float:
        scan = self.rig.start_scan(now_s)
        scan.wait()
        assert self.rig.ended(scan.end_s) is scan
        return scan.end_s


def test_pulses_and_crashes_are_totals_with_a_line_each() -> None:
    bench = Bench(tip_changes={"pulse_cures": 0.0, "pulse_worsens": 1.0, "pulse_threshold_v": 0.5})
    bench.rig.pulse(-4.0, 0.1, 1001.0)
    bench.rig.pulse(3.0, 0.2, 1002.0)
    bench.rig.crash(5e-9, 50e-9, 1003.0)
    bench.rig.crash(10e-9, 50e-9, 1004.0)
    lines = bench.ledgers()
    assert [line["cause"] for line in lines] == ["pulse", "pulse", "crash", "crash"]
    last = lines[-1]
    assert (last["pulses"], last["crashes"], last["in_keep_away"]) == (2, 2, 0)
    assert last["pulse_v_s"] == pytest.approx(1.0)
    assert last["crash_depth_m"] == pytest.approx(15e-9)
    outcomes = [line["outcome"] for line in bench.lines if line["event"] in ("pulse", "crash")]
    assert (last["cured"], last["worsened"]) == (outcomes.count("cured"), outcomes.count("worsened"))
    marks = bench.rig.world.sample.marks
    assert len(marks) >= 3
    assert last["marked_m2"] == pytest.approx(sum(math.pi * mark.radius_m**2 for mark in marks))


def test_retracted_tip_damages_nothing() -> None:
    bench = Bench()
    bench.rig.withdraw(1001.0)
    bench.rig.pulse(4.0, 0.1, 1003.0)
    bench.rig.crash(5e-9, 50e-9, 1004.0)
    assert bench.ledgers() == []


def test_treatment_near_a_scanned_place_counts_also_after_drift() -> None:
    bench = Bench(drift={"velocity_m_per_s": [20e-9, 0.0, 0.0]}, scanner={"oversampling": 1})
    end_s = bench.scan(1001.0)  # 1 um wide, about the origin
    bench.rig.setup.move_speed_m_s = 1.0
    bench.rig.move_probe((2.0e-6, 0.0), end_s)
    bench.rig.pulse(1.0, 0.1, end_s + 1.0)
    assert bench.ledgers()[-1]["in_keep_away"] == 0
    later_s = end_s + 60.0  # the scanned place has drifted 1.2 um towards the probe
    bench.rig.pulse(1.0, 0.1, later_s)
    assert bench.ledgers()[-1]["in_keep_away"] == 1
    clearances = [line["clearance_m"] for line in bench.lines if line["event"] == "pulse"]
    assert clearances[0] > 1.2e-6
    assert clearances[1] < 500e-9


def test_distance_from_a_turned_region() -> None:
    turned = Region((0.0, 0.0), (4.0, 2.0), math.pi / 2)
    assert distance_m((0.0, 3.0), turned) == pytest.approx(1.0)
    assert distance_m((4.0, 6.0), turned) == pytest.approx(5.0)
    assert distance_m((0.9, 1.9), turned) == 0.0


def test_time_with_the_feedback_off_counts_only_while_engaged() -> None:
    bench = Bench()
    bench.rig.switch_feedback(1010.0, on=False)
    bench.rig.switch_feedback(1015.0, on=True)
    bench.rig.switch_feedback(1020.0, on=False)
    bench.rig.withdraw(1022.0)
    bench.rig.account(1100.0)
    assert bench.ledgers()[-1]["feedback_off_s"] == pytest.approx(7.0)
    assert bench.ledgers()[0]["cause"] == "feedback"


def test_saturated_current_of_a_scan_and_of_a_spectrum_counts() -> None:
    gentle = Bench(surface="lattice")
    gentle.scan(1001.0)
    assert gentle.ledgers() == []
    bench = Bench(surface="lattice", signals={"preamplifier_a": 20e-12}, iv={"preamplifier_a": 20e-12})
    end_s = bench.scan(1001.0)
    (line,) = bench.ledgers()
    assert line["cause"] == "scan"
    assert 3.0 < line["saturated_s"] <= 4.0
    curve = bench.rig.start_spectrum("IV", end_s)
    bench.rig.ended(curve.end_s)
    assert bench.ledgers()[-1]["cause"] == "spectrum"
    assert bench.ledgers()[-1]["saturated_s"] > line["saturated_s"]


def test_scan_that_presses_counts_with_its_indentation() -> None:
    bench = Bench(surface="particles")
    end_s = bench.scan(1001.0)
    assert bench.ledgers() == []
    bench.rig.setup.line_s = 0.02  # far too fast for the feedback
    bench.scan(end_s + 1.0)
    (line,) = bench.ledgers()
    assert line["pressed_scans"] == 1
    assert line["pressed_m"] >= PRESSED_FROM_M


def test_coarse_move_counts_only_while_engaged() -> None:
    bench = Bench()
    bench.rig.shift_sample((1e-6, 0.0), 1.0, 1001.0)
    bench.rig.withdraw(1010.0)
    bench.rig.shift_sample((1e-6, 0.0), 1.0, 1020.0)
    assert bench.ledgers()[-1]["stage_moves"] == 1


def test_ledger_survives_a_kill() -> None:
    bench = Bench()
    end_s = bench.scan(1001.0)
    bench.rig.pulse(3.0, 0.1, end_s)
    kept = json.loads(json.dumps(bench.rig.state()))
    again = Bench()
    again.rig.restore(kept)
    assert again.rig.ledger == bench.rig.ledger
    again.rig.pulse(3.0, 0.1, end_s + 5.0)
    assert again.rig.ledger.pulses == 2
    assert again.rig.ledger.in_keep_away == 2


def test_scan_that_was_running_at_a_kill_counts_once() -> None:
    bench = Bench(surface="lattice", signals={"preamplifier_a": 20e-12})
    scan = bench.rig.start_scan(1001.0)
    kept = json.loads(json.dumps(bench.rig.state()))
    again = Bench(surface="lattice", signals={"preamplifier_a": 20e-12})
    again.rig.restore(kept)
    again.rig.ended(scan.end_s)
    again.rig.account(scan.end_s + 1.0)
    assert again.rig.ledger.saturated_s <= 4.0
    assert len(again.ledgers()) == 1


def test_time_that_passes_alone_adds_no_line() -> None:
    ledger = DamageLedger(0.0)
    assert ledger.at(5.0, feedback_off=False).same_totals(ledger)
    assert not ledger.at(5.0, feedback_off=True).same_totals(ledger)
