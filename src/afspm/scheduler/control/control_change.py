"""Changes of control: the arbitration table is applied, and the consequences are carried out."""

from __future__ import annotations

from dataclasses import dataclass

from afspm.basics.frozen import replace
from afspm.model import ControlMode, ControlResponse, Problem, ResponseDetail, names
from afspm.model.idempotency_cache import RequestStatus
from afspm.model.microscope_status import feedback_of
from afspm.model.sessions import token_of
from afspm.scheduler.control.arbitration import (
    ArbitrationState,
    Cause,
    ControlChange,
    ControlInput,
    Transition,
    apply,
    reason,
    row_for,
)
from afspm.scheduler.control.descriptions import change_text, is_routine
from afspm.scheduler.events import RequestIn
from afspm.scheduler.publishing.event_log import control_entries
from afspm.scheduler.publishing.own_packets import publish_control
from afspm.scheduler.requests import answers
from afspm.scheduler.safety import safety_commands
from afspm.scheduler.safety.grants import AGENT_LEASE_S
from afspm.scheduler.state import StateDraft

TRANSLATOR = "translator"
"""The name under which the scheduler flags a lost microscope: a translator sends no requests itself."""


@dataclass(frozen=True)
class _Change:
    """A change of control, with the input and the row of the table that caused it.

    Attributes:
        had_died: whether the request comes from a later process of the holder than the process that got control.
    """

    before: ArbitrationState
    after: ArbitrationState
    ask: ControlInput
    row: Transition
    had_died: bool

    @property
    def cause(self) -> Cause | None:
        """The reason why the microscope may be unattended: the cause in the row, or the end; None: no reason."""
        # a person at the microscope attends to the tip, also at the end of the experiment
        if self.after.ended and self.before.mode is not ControlMode.MANUAL:
            return Cause.ENDED
        return self.row.cause


def decide(draft: StateDraft, ask: ControlInput, event: RequestIn | None = None) -> bool:
    """Apply the arbitration table; return whether the translator must answer the request.

    Args:
        event: the request; None: the input is not a request.
    """
    before, rules = draft.control, draft.env.settings.rules
    row = row_for(before, ask, rules)
    if ControlChange.FORWARD in row.do:
        return True
    draft.control = after = apply(row, before, ask)
    token = None if event is None else token_of(ask.who, event.request.id)
    if before.holder is None and after.holder is not None:
        draft.lease = replace(draft.lease, token=token)
    if after != before:
        had_died = ask.who == before.holder and is_other_life(draft, token)
        _carry_out(draft, _Change(before, after, ask, row, had_died))
    if after.ended and not before.ended:
        begin_end(draft)
    if event is not None and row.response is not None:
        answer_unless_ending(draft, event, row.response, reason(row, before, ask, rules))
    return False


def is_other_life(draft: StateDraft, token: str | None) -> bool:
    """Return whether a session token belongs to another process than the holder that was granted control."""
    return None not in (token, draft.lease.token) and token != draft.lease.token


def begin_end(draft: StateDraft) -> None:
    """Begin the end of the experiment, which waits, for a limited time, until the tip is out of danger."""
    draft.watchdog = draft.watchdog.hurry(draft.now_s)
    settings = draft.env.settings
    draft.end = draft.end.begin(draft.now_s + settings.control.request_timeout_s + settings.waits.answer_s)


def answer_unless_ending(
    draft: StateDraft,
    event: RequestIn,
    code: ControlResponse,
    why: str,
    detail: ResponseDetail = ResponseDetail.NONE,
) -> None:
    """Answer a request; while the experiment ends, delay the answer until the tip is out of danger."""
    if (kept := draft.end.keep((event, code, why, detail))) is not None:
        draft.end = kept
        # a retry meanwhile waits for this answer, and gets no second one
        draft.idempotency = draft.idempotency.noted(event.name, event.request, RequestStatus.PENDING)
    else:
        answers.answer(draft, event, code, why, detail=detail)


def _carry_out(draft: StateDraft, change: _Change) -> None:
    # all of it precedes the answer to the request that caused the change
    before, after = change.before, change.after
    rules = draft.env.settings.rules
    problems = rules.problems
    draft.grants = draft.grants.control_changed(before, after, rules.by_hand, draft.now_ns)
    entries = control_entries(draft.now_ns, before, after, change.ask, change.row, problems)
    draft.event_log = draft.event_log.add(draft.now_s, *entries)
    draft.lease = draft.lease.held_by(after.holder, draft.now_ns)
    solved = before.problems.keys() - after.problems.keys()
    if before.solving in solved and change.ask.who == before.holder:
        draft.plans, notes = draft.plans.solved(change.ask.who)
        draft.warn(notes)
    if before.holder != after.holder:
        draft.plans = draft.plans.unsolved()
        draft.loans = draft.loans.nothing_stated()
        if after.solving:  # a repair, and what judges it, takes place at the base
            others = [key for key, loan in draft.loans.loans.items() if loan.lender != after.holder]
            draft.loans = draft.loans.ended(others)
    if before.mode is not after.mode:
        draft.others_may_have_acted(by="" if after.mode is ControlMode.MANUAL else change.ask.who)
    if draft.panel.why and after.mode is not ControlMode.MANUAL:  # a person has let the run continue
        draft.panel = replace(draft.panel, why="")
        if draft.microscope.risk.holds_z:  # its holder has lost control, and another component may get it
            draft.watchdog = draft.watchdog.stopping(names.RELEASE_Z)
    if after.holder is not None and after.holder != before.holder and rules.is_agent(after.holder):
        draft.lease = draft.lease.asked(AGENT_LEASE_S, draft.now_s)  # also for a client that requests no lease
    _log_change(draft, change, _alert_watchdog(draft, change))
    if after.ended:
        answers.call_back(draft, None, Cause.ENDED)
    elif before.holder is not None and after.holder is None:
        answers.call_back(draft, before.holder, change.row.cause)
    elif before.mode is ControlMode.MANUAL and after.mode is not ControlMode.MANUAL:
        answers.call_back(draft, None, None)
    safety_commands.send(draft)
    if after.published() != before.published():
        publish_control(draft)


def _alert_watchdog(draft: StateDraft, change: _Change) -> list[str]:
    cause, former, ask = change.cause, change.before.holder, change.ask
    malfunction = Problem.DEVICE_MALFUNCTION
    if malfunction in change.before.problems.keys() - change.after.problems.keys() and ask.who != TRANSLATOR:
        # a cleared malfunction means that the tip is well: it may be at the surface, where it can be in danger again
        draft.watchdog = draft.watchdog.seen_to()
        draft.microscope = draft.microscope.with_tip(away=False)
    if cause is None or (former is None and cause not in (Cause.MANUAL, Cause.BY_HAND, Cause.ENDED, Cause.STOPPED)):
        return []
    flight = draft.forwarder.flight
    feedback = None if flight is None else feedback_of(flight.request)
    # a request in flight can't be called back: it may still switch the feedback off
    if feedback is not None and feedback.on is False:
        draft.microscope = draft.microscope.feedback_may_be_off()
    before = draft.watchdog
    draft.watchdog = before.control_taken(
        cause,
        draft.forwarder.action_in_flight,
        draft.microscope,
        had_died=change.had_died,
        by_holder=ask.who == former,
        was_seen_to=change.before.sees_to_tip,
    )
    return draft.watchdog.newly_wanted(before)


def _log_change(draft: StateDraft, change: _Change, wanted: list[str]) -> None:
    before, after, ask, cause = change.before, change.after, change.ask, change.cause
    routine = is_routine(before, after, ask, draft.lease.announced)
    level = "WARNING" if cause is Cause.BY_HAND else "DEBUG" if routine else "INFO"
    draft.log(level, change_text(before, after, ask, change.row, draft.env.settings.rules))
    draft.lease = replace(draft.lease, announced=after.holder or draft.lease.announced)
    is_sent = "is sent to the microscope" if draft.forwarder.up else "will be sent when the translator is back"
    for action in wanted:
        why = f"{before.holder} had died in control" if change.had_died else cause.text if cause else ""
        draft.log("WARNING", f"{action} {is_sent}, since {why}")
    from_hand = before.mode is ControlMode.MANUAL and after.mode is not ControlMode.MANUAL
    if from_hand:
        draft.by_hand, left = draft.by_hand.handed_back()
        if left:
            draft.log("WARNING", f"set by hand, and still in force: {', '.join(left)}")
    if (cause is None and not from_hand) or draft.watchdog.owes_retract:
        return
    draft.microscope, danger = draft.microscope.telling()
    if danger is not None:
        expected = cause in (None, Cause.RELEASED, Cause.SOLVED, Cause.MANUAL, Cause.BY_HAND)
        why = cause.text if cause else "the mode is automated again"
        draft.log("WARNING" if expected else "CRITICAL", f"{danger}, and no component is in control: {why}")
