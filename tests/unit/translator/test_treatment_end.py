"""The end of a pulse or crash: proved by the current, never only by the clock."""

from __future__ import annotations

import logging
from types import SimpleNamespace
from typing import Any

import pytest

from afspm.basics.errors import Refused
from afspm.model import ScopeState, ScopeStatus, names
from afspm.translator.parameters import FEEDBACK_ON, ParameterTable
from afspm.translator.treatment_end import BETWEEN_S, LONGEST_S, TreatmentEnd

FREE, MOVING = ScopeState.FREE, ScopeState.MOVING


class Tip:
    """A driver whose current and feedback change as told by a test."""

    def __init__(self, unit: str = "A") -> None:
        self.table = ParameterTable({}).extended(
            {names.ZCTRL_SETPOINT: {"unit": unit}, FEEDBACK_ON: {"type": "bool"}}, where="here"
        )
        self.now_s: float = 1000.0
        self.current, self.on, self.state = -1e-10, True, FREE
        self.clock = SimpleNamespace(now_s=lambda: self.now_s)

    def in_force(self, wanted: list[str]) -> dict[str, Any]:
        return {name: {names.ZCTRL_SETPOINT: 1e-10, FEEDBACK_ON: self.on}[name] for name in wanted}

    def current_a(self) -> float | None:
        return self.current

    def status(self) -> ScopeStatus:
        return ScopeStatus(self.state)


class Treated:
    """A tip after a crash.

    Attributes:
        kept: as after a restart: `end` is made anew for each look.
    """

    def __init__(self, tip: Tip) -> None:
        self.tip, self.kept = tip, dict[str, Any]()
        self.end.expect(names.CRASH, MOVING)

    @property
    def end(self) -> TreatmentEnd:
        return TreatmentEnd(self.tip, self.kept, logging.getLogger("tip"))  # type: ignore[arg-type]

    def later(self, seconds: float) -> ScopeState | None:
        self.tip.now_s += seconds
        status = self.end.status()
        return None if status is None else status.state


@pytest.fixture
def treated() -> Treated:
    return Treated(Tip())


def test_treatment_is_over_at_the_second_reading_near_the_setpoint(treated: Treated) -> None:
    treated.tip.state, treated.tip.on = ScopeState.COARSE_MOTOR, False
    assert treated.later(0.1) is ScopeState.COARSE_MOTOR  # what the controller shows counts first
    treated.tip.state = FREE
    assert treated.later(0.1) is MOVING
    treated.tip.on = True
    assert treated.later(0.1) is MOVING
    assert treated.end.next_s == pytest.approx(treated.tip.now_s + BETWEEN_S)
    assert treated.later(BETWEEN_S - 0.1) is MOVING
    assert treated.later(0.1) is FREE
    assert treated.later(0.1) is None
    treated.end.refuse_start()


@pytest.mark.parametrize("current", [1e-8, 1e-12, 0.0])
def test_saturated_or_lost_current_between_two_readings_begins_the_wait_again(treated: Treated, current: float) -> None:
    assert treated.later(0.1) is MOVING
    treated.tip.current = current
    assert treated.later(BETWEEN_S) is MOVING
    treated.tip.current = 1.8e-10
    assert treated.later(0.1) is MOVING
    assert treated.later(BETWEEN_S) is FREE


def test_treatment_without_its_current_ends_with_a_warning_and_starts_need_the_feedback(
    treated: Treated, caplog: pytest.LogCaptureFixture
) -> None:
    treated.tip.on = False
    assert treated.later(0.1) is MOVING
    assert treated.later(LONGEST_S - 0.1) is MOVING
    assert treated.later(0.1) is FREE
    assert "5 s after x-crash the current is not at its setpoint: the feedback is off" in caplog.text
    with pytest.raises(Refused, match="after x-crash the feedback is off"):
        treated.end.refuse_start()
    treated.tip.on = True
    treated.end.refuse_start()
    treated.tip.on = False  # by a request of the run, later on
    treated.end.refuse_start()


# makers L1
@pytest.mark.parametrize("is_left_off", [True, False])
def test_feedback_that_the_run_switches_off_after_an_unproved_treatment_lets_it_measure(
    treated: Treated, is_left_off: bool
) -> None:
    treated.tip.current, treated.tip.on = 0.0, not is_left_off
    assert treated.later(0.1) is MOVING
    assert treated.later(LONGEST_S) is FREE
    treated.tip.on = True
    assert treated.later(1.0) is None
    treated.tip.on = False
    treated.end.refuse_start()


# makers L1: "not at its setpoint … 1.01 of the setpoint"
def test_current_that_comes_back_at_the_last_moment_is_read_once_more(
    treated: Treated, caplog: pytest.LogCaptureFixture
) -> None:
    treated.tip.current = 1e-8
    assert treated.later(0.1) is MOVING
    assert treated.later(LONGEST_S - 0.1) is MOVING
    treated.tip.current = 1.01e-10
    assert treated.later(0.1) is MOVING
    assert treated.later(BETWEEN_S) is FREE
    assert not caplog.text


@pytest.mark.parametrize("why", ["deflection", "no current shown", "feedback off"])
def test_nothing_is_awaited_where_the_feedback_holds_no_current(why: str) -> None:
    tip = Tip("V" if why == "deflection" else "nA")
    tip.on = why != "feedback off"
    if why == "no current shown":
        tip.current = None  # type: ignore[assignment]
    assert Treated(tip).later(0.1) is None
