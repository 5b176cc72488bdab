"""The microscope as far as it is known: what it does, whether it can be trusted, and what endangers its tip."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model import Feedback, Parameter, Request, ScopeState, names

FEEDBACK_OFF = "feedback-off"
"""The name of the dangerous state in which the feedback is known to be switched off."""
STOPS = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
"""The actions that stop what runs."""
STARTS = {names.START_SCAN: names.STOP_SCAN, names.START_SPEC: names.STOP_SPEC}
"""The actions that start something, with those that stop it."""
_OFF = names.OFF_WORDS | {"0.0"}  # a translator that is not ours may take a number


@dataclass(frozen=True)
class TipRisk:
    """The part of the status that endangers the tip; it survives a restart.

    Attributes:
        state: the last that is known; a microscope that is lost goes on with it.
        feedback_on: None: not known.
        tip_away: the tip is withdrawn: neither the coarse motor nor a feedback that is off does harm.
    """

    state: ScopeState = ScopeState.UNDEFINED
    feedback_on: bool | None = None
    tip_away: bool = False


@dataclass(frozen=True)
class MicroscopeStatus:
    """Everything that is known of the microscope's activity.

    Attributes:
        dangerous: names of ScopeState, and "feedback-off".
        patience_s: how long (real) the controller may be lost before that is a problem: one that is found again within
            that time costs nothing, what runs there goes on.
        state: as it was told last; UNDEFINED of a microscope whose controller is gone or makes no sense.
        states_seen: how many states have been told.
        lost_since_s: since when (real) nothing is known of it.
        feedback_before: what the feedback was before a request of unknown outcome.
        in_doubt: there is such a request.
        told: the danger that was logged.
    """

    dangerous: Collection[str] = ()
    patience_s: float = 5.0
    state: ScopeState = ScopeState.UNDEFINED
    states_seen: int = 0
    lost_since_s: float | None = None
    risk: TipRisk = TipRisk()
    feedback_before: bool | None = None
    in_doubt: bool = False
    told: str | None = None

    @property
    def is_free(self) -> bool:
        """True while it does nothing, as far as is known."""
        return self.state is ScopeState.FREE or not self.states_seen

    @property
    def lost_at_s(self) -> float | None:
        """When, real, it has been lost for too long; None: it is not lost."""
        return None if self.lost_since_s is None else self.lost_since_s + self.patience_s

    def with_state(self, state: ScopeState, now_s: float) -> MicroscopeStatus:
        """Take the state that the translator told."""
        told = replace(self, state=state, states_seen=self.states_seen + 1)
        if state is ScopeState.UNDEFINED:
            return replace(told, lost_since_s=now_s) if self.lost_since_s is None else told
        return replace(told, lost_since_s=None)._with_risk(replace(self.risk, state=state))

    def with_feedback(self, feedback: Feedback) -> MicroscopeStatus:
        """Take what is known of the feedback now."""
        if feedback.on is None:
            return self
        certain = replace(self, in_doubt=False)
        if feedback.on is self.risk.feedback_on:
            return certain
        away = self.risk.tip_away and not feedback.on
        return certain._with_risk(replace(self.risk, feedback_on=feedback.on, tip_away=away))

    def feedback_may_be_off(self) -> MicroscopeStatus:
        """Reckon with a feedback that is off: a request switches it off, or may have done so."""
        changed = self.with_feedback(Feedback(on=False))
        if changed.risk.feedback_on is self.risk.feedback_on:
            return changed
        return replace(changed, feedback_before=self.risk.feedback_on, in_doubt=True)

    def feedback_was_left(self) -> MicroscopeStatus:
        """Undo `feedback_may_be_off`: the request was refused."""
        if not self.in_doubt:
            return self
        return replace(self, in_doubt=False)._with_risk(replace(self.risk, feedback_on=self.feedback_before))

    def with_tip(self, *, away: bool) -> MicroscopeStatus:
        return self._with_risk(replace(self.risk, tip_away=away))

    def after_action(self, action: str, *, is_away: bool) -> MicroscopeStatus:
        """Take an action that was, or may have been, carried out: what does not just start or stop may move the tip."""
        only_runs = action in STARTS or action in STOPS.values()
        return self if only_runs else self.with_tip(away=is_away)

    @property
    def endangered_by_feedback(self) -> bool:
        risk = self.risk
        return risk.feedback_on is False and FEEDBACK_OFF in self.dangerous and not risk.tip_away

    @property
    def danger(self) -> str | None:
        """The danger that the tip is in, in words; None: none, or it was seen to."""
        if self.risk.tip_away:
            return None
        if self.endangered_by_feedback:
            return "the feedback is off"
        name = self.risk.state.name
        return f"the microscope is in {name}" if name in self.dangerous else None

    def telling(self) -> tuple[MicroscopeStatus, str | None]:
        """Return the danger if it was not logged yet: each once."""
        danger = self.danger
        return replace(self, told=danger), None if danger == self.told else danger

    def _with_risk(self, risk: TipRisk) -> MicroscopeStatus:
        changed = replace(self, risk=risk)
        return replace(changed, told=None) if changed.danger is None else changed


def feedback_of(request: Request) -> Feedback | None:
    """Return the feedback that a request sets; None: it sets none of it."""
    subject = request.subject
    if isinstance(subject, Parameter) and subject.name == names.FEEDBACK_ON and subject.value is not None:
        return Feedback(on=subject.value.strip().lower() not in _OFF)
    return subject if isinstance(subject, Feedback) else None
