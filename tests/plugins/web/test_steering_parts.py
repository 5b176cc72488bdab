"""Inputs and choices of a person, and the advice about a problem."""

from __future__ import annotations

import math
from typing import Any

import pytest

from afspm import wire
from afspm.basics import InvalidValue, UnitError
from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlState,
    JournalEntries,
    JournalEntry,
    Problem,
    Region,
    RescanKind,
)
from afspm.night import Overview
from afspm.plugins.web.dashboard.actions import unclear
from afspm.plugins.web.dashboard.flags import flags
from afspm.plugins.web.dashboard.scan_dialog import ScanChoice

S = 1_000_000_000
CHOICE = ScanChoice(Region((1e-6, 2e-6), (4e-7, 2e-7), 0.3), (32, 64))


@pytest.mark.parametrize(
    ("parameter", "text"),
    [("scan-speed", "4 µm/s"), ("scan-resolution-x", "64"), ("zctrl-setpoint", "0.5"), ("tip-bias-voltage", "-0.1 V")],
)
def test_a_value_with_its_unit_is_clear(parameter: str, text: str) -> None:
    assert unclear(parameter, text, "") == ""


def test_a_number_without_its_unit_is_not_taken_for_metres() -> None:
    wanted = 'scan-speed: write the unit as well, for example "8 µm/s".'
    assert unclear("scan-speed", "8", "4 µm/s") == wanted
    assert "0.5 mV" in unclear("zctrl-setpoint", "0.5", "700 mV"), "its unit is that of the microscope"
    assert "write a value" in unclear("scan-speed", " ", "4 µm/s")
    assert "number" in unclear("scan-speed", "fast", "4 µm/s")


def test_a_scan_is_edited_with_units_and_has_square_pixels() -> None:
    edited = CHOICE.edited("1 um", "500 nm", "128")
    assert edited.region == Region((1e-6, 2e-6), (1e-6, 5e-7), 0.3)
    assert edited.shape == (64, 128)


def test_a_scan_is_rotated_by_an_angle_with_its_unit() -> None:
    assert CHOICE.edited("1 um", "1 um", "8", "-90 deg").region.angle_rad == pytest.approx(-math.pi / 2)
    with pytest.raises(UnitError):
        CHOICE.edited("1 um", "1 um", "8", "30")


def test_a_person_is_in_control_in_manual_mode() -> None:
    overview = Overview()
    assert overview.in_control == ""
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, "series"), S)
    assert (overview.in_control, overview.control_since_ns) == ("series", S)
    overview.take("ControlState", ControlState(ControlMode.MANUAL), 2 * S)
    assert (overview.in_control, overview.control_since_ns) == ("a person", 2 * S)
    changed = JournalEntry(
        2 * S, "control", "dashboard:Ada", "", event=ControlEvent.MODE_CHANGED, mode=ControlMode.MANUAL
    )
    overview.take("JournalEntries", JournalEntries((changed,)), 2 * S + 1)
    assert overview.in_control == "Ada"
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED), 3 * S)
    assert overview.in_control == ""


def test_a_scan_is_made_a_square_of_its_longer_side() -> None:
    assert CHOICE.squared() == ScanChoice(Region((1e-6, 2e-6), (4e-7, 4e-7), 0.3), (64, 64))


@pytest.mark.parametrize(
    ("width", "height", "pixels"),
    [("400", "400 nm", "64"), ("-1 nm", "1 nm", "64"), ("0 nm", "1 nm", "8"), ("1 nm", "2 V", "8"),
     ("1 nm", "1 nm", "0"), ("1 nm", "1 nm", "6.5"), ("1 nm", "1 nm", "99999"), ("inf nm", "1 nm", "8")],
)  # fmt: skip
def test_impossible_scans_are_refused(width: str, height: str, pixels: str) -> None:
    with pytest.raises((UnitError, InvalidValue)):
        CHOICE.edited(width, height, pixels)


def test_a_problem_has_advice_and_names_the_component_that_solves_it() -> None:
    overview = Overview()
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, None, (int(Problem.TIP_SHAPE_CHANGED), 9)), S)
    tip, own = flags(overview)
    assert (tip.name, tip.since_ns) == ("tip-shape-changed", S)
    assert tip.advice == "No component works on it. Take over, condition or change the tip, then clear the problem."
    assert "then clear it" in own.advice
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, "tip_corrector", (1,)), 2 * S)
    (tip,) = flags(overview)
    assert tip.advice == "tip_corrector is in control to solve it: wait, or take over."
    overview.take("ControlState", ControlState(ControlMode.MANUAL, None, (1,)), 3 * S)
    (tip,) = flags(overview)
    assert tip.advice == "Condition or change the tip, then clear the problem."


def test_the_first_thermal_drift_is_shown_as_normal() -> None:
    overview = Overview()
    overview.take("ControlState", ControlState(ControlMode.AUTOMATED, None, (int(Problem.THERMAL_DRIFT),)), S)
    asked: Any = wire.message_type("DriftRescan")(kind=int(RescanKind.OPPOSITE))
    asked.timestamp.FromNanoseconds(S)
    (before,) = flags(overview)
    overview.take("DriftRescan", asked, S + 1)
    (drift,) = flags(overview)
    assert "Take over" in before.advice
    assert drift.advice.startswith("normal at the start")
