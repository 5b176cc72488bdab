"""The known status of the microscope: its activity, whether its controller is lost, and the danger to its tip."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model import ControlRequest, Feedback, Parameter, Request, ScopeState, names

FEEDBACK_OFF = "feedback-off"
"""The name in `dangerous` for a feedback that is known to be off."""
STOPS = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
"""Actions that stop a running scan or spectrum."""
STARTS = {names.START_SCAN: names.STOP_SCAN, names.START_SPEC: names.STOP_SPEC}
"""Actions that start a scan or spectrum, each with the action that stops it."""
_OFF = names.OFF_WORDS | {"0.0"}  # translators of other makes may take a number


@dataclass(frozen=True)
class TipRisk:
    """The part of the status that shows a danger to the tip; kept over a restart.

    Attributes:
        state: the last known state, which lasts even after the loss of the controller.
        feedback_on: None if unknown.
        tip_away: whether the tip is withdrawn, so that neither the coarse motor nor a switched-off feedback does harm.
        holds_z: whether the holder has asked to hold z, and its way back was not asked for yet.
    """

    state: ScopeState = ScopeState.UNDEFINED
    feedback_on: bool | None = None
    tip_away: bool = False
    holds_z: bool = False

    @property
    def has_no_feedback(self) -> bool:
        """Whether the feedback is off while the tip is at the surface."""
        return self.feedback_on is False and not self.tip_away


@dataclass(frozen=True)
class MicroscopeStatus:
    """The known activity of the microscope.

    Attributes:
        dangerous: states that endanger the tip: names of ScopeState, and "feedback-off".
        patience_s: real time after which the loss of the controller becomes a problem. If the controller returns
            before, its scan continues.
        state: the last published state; UNDEFINED for a lost controller or invalid answers.
        states_seen: number of states received.
        lost_since_s: real time of the loss of the controller.
        feedback_before: the feedback before a request of unknown outcome.
        in_doubt: whether a request of unknown outcome may have changed the feedback.
        logged: the danger that was logged last.
        expected: the states that a started action may have led to, and that were not published yet.
        expected_until_s: the real time after which the published state alone counts.
    """

    dangerous: Collection[str] = ()
    patience_s: float = 5.0
    state: ScopeState = ScopeState.UNDEFINED
    states_seen: int = 0
    lost_since_s: float | None = None
    risk: TipRisk = TipRisk()
    feedback_before: bool | None = None
    in_doubt: bool = False
    logged: str | None = None
    expected: tuple[ScopeState, ...] = ()
    expected_until_s: float = 0.0

    @property
    def is_free(self) -> bool:
        """Return whether the microscope is free; True before its first published state."""
        return self.state is ScopeState.FREE or not self.states_seen

    @property
    def lost_at_s(self) -> float | None:
        """Return the real time at which a loss becomes a problem; None if the microscope is not lost."""
        return None if self.lost_since_s is None else self.lost_since_s + self.patience_s

    def with_state(self, state: ScopeState, now_s: float) -> MicroscopeStatus:
        """Return the status after a state that the translator published."""
        expected = () if state in self.expected else self.expected
        changed = replace(self, state=state, states_seen=self.states_seen + 1, expected=expected)
        if state is ScopeState.UNDEFINED:
            return replace(changed, lost_since_s=now_s) if self.lost_since_s is None else changed
        # the answer to a withdrawal comes at its beginning: it may fail later
        is_broken_off = state is ScopeState.INTERRUPTED and self.risk.state is ScopeState.COARSE_MOTOR
        away = self.risk.tip_away and not is_broken_off
        return replace(changed, lost_since_s=None)._with_risk(replace(self.risk, state=state, tip_away=away))

    def expecting(self, *states: ScopeState, until_s: float) -> MicroscopeStatus:
        """Return the status after an action that leads to a state: packets of older states may come before its own."""
        return self if self.state in states else replace(self, expected=states, expected_until_s=until_s)

    def possible_states(self, now_s: float) -> tuple[ScopeState, ...]:
        """Return the states in which the microscope may be; empty if unknown."""
        if self.state is ScopeState.UNDEFINED:
            return ()
        return (self.state, *(self.expected if now_s < self.expected_until_s else ()))

    def with_feedback(self, feedback: Feedback) -> MicroscopeStatus:
        """Return the status with a published feedback; unchanged if `feedback.on` is unknown."""
        if feedback.on is None:
            return self
        certain = replace(self, in_doubt=False)
        if feedback.on is self.risk.feedback_on:
            return certain
        away = self.risk.tip_away and not feedback.on
        return certain._with_risk(replace(self.risk, feedback_on=feedback.on, tip_away=away))

    def feedback_may_be_off(self) -> MicroscopeStatus:
        """Return the status with the feedback assumed off: a request switches it off, or may have done so."""
        changed = self.with_feedback(Feedback(on=False))
        if changed.risk.feedback_on is self.risk.feedback_on:
            return changed
        return replace(changed, feedback_before=self.risk.feedback_on, in_doubt=True)

    def feedback_was_left(self) -> MicroscopeStatus:
        """Return the status with the feedback from before `feedback_may_be_off`, after a refusal of the request."""
        if not self.in_doubt:
            return self
        return replace(self, in_doubt=False)._with_risk(replace(self.risk, feedback_on=self.feedback_before))

    def with_tip(self, *, away: bool) -> MicroscopeStatus:
        return self._with_risk(replace(self.risk, tip_away=away))

    def after_action(self, action: str, *, is_away: bool) -> MicroscopeStatus:
        """Return the status after a possibly executed action; all but starts and stops may move the tip."""
        # to start or stop a scan or spectrum neither engages nor withdraws the tip
        only_runs = action in STARTS or action in STOPS.values()
        return self if only_runs else self.with_tip(away=is_away).holding_z(action)

    def holding_z(self, action: str) -> MicroscopeStatus:
        """Return the status after an action that may hold z, or end that."""
        holds = {names.HOLD_Z: True, names.RELEASE_Z: False}.get(action, self.risk.holds_z)
        return self._with_risk(replace(self.risk, holds_z=holds))

    @property
    def endangered_by_feedback(self) -> bool:
        return self.risk.has_no_feedback and FEEDBACK_OFF in self.dangerous

    @property
    def danger(self) -> str | None:
        """Return the danger to the tip, in words; None without a danger, or with the tip withdrawn."""
        if self.risk.tip_away:
            return None
        if self.endangered_by_feedback:
            return "the feedback is off"
        name = self.risk.state.name
        return f"the microscope is in {name}" if name in self.dangerous else None

    def telling(self) -> tuple[MicroscopeStatus, str | None]:
        """Return the next status, and the danger in words if it was not logged yet, else None."""
        danger = self.danger
        return replace(self, logged=danger), None if danger == self.logged else danger

    def _with_risk(self, risk: TipRisk) -> MicroscopeStatus:
        changed = replace(self, risk=risk)
        return replace(changed, logged=None) if changed.danger is None else changed


def feedback_of(request: Request) -> Feedback | None:
    """Return the feedback that a request sets; None if it sets none.

    The way back of a held z sets none: it switches the feedback on later, if all of it succeeds.
    """
    subject = request.subject
    if request.kind == ControlRequest.ACTION and subject == names.HOLD_Z:
        return Feedback(on=False)
    if isinstance(subject, Parameter) and subject.name == names.FEEDBACK_ON and subject.value is not None:
        return Feedback(on=subject.value.strip().lower() not in _OFF)
    return subject if isinstance(subject, Feedback) else None
