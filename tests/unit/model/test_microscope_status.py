"""The danger to the tip, as far as it is known from states, feedback and actions."""

from __future__ import annotations

from afspm.model import Feedback, ScopeState
from afspm.model.microscope_status import FEEDBACK_OFF, MicroscopeStatus


def test_withdrawal_that_fails_after_its_answer_leaves_the_tip_in_danger() -> None:
    status = MicroscopeStatus(dangerous=(FEEDBACK_OFF,)).with_feedback(Feedback(on=False))
    answered = status.after_action("x-retract", is_away=True).with_state(ScopeState.COARSE_MOTOR, 1.0)
    assert answered.danger is None
    assert answered.with_state(ScopeState.FREE, 2.0).danger is None
    assert answered.with_state(ScopeState.INTERRUPTED, 2.0).danger == "the feedback is off"


def test_interrupted_scan_before_a_withdrawal_does_not_undo_it() -> None:
    scanning = MicroscopeStatus(dangerous=(FEEDBACK_OFF,)).with_feedback(Feedback(on=False))
    scanning = scanning.with_state(ScopeState.SCANNING, 1.0).after_action("x-retract", is_away=True)
    assert scanning.with_state(ScopeState.INTERRUPTED, 2.0).danger is None
