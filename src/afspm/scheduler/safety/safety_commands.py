"""The scheduler's own requests for the safety of the tip, which are sent before all others."""

from __future__ import annotations

from afspm.model import ControlRequest, ControlResponse, Request, Response, names
from afspm.scheduler.requests.forwarder import ForwardedRequest, ForwardOutcome
from afspm.scheduler.safety.watchdog import SafetyResult, TipDuty
from afspm.scheduler.state import StateDraft

_ID = "scheduler/does-it-retract"


def begin(draft: StateDraft) -> None:
    """Check whether a new translator supports the retract, then send the due actions of the watchdog."""
    action = draft.watchdog.question
    # any answer also shows that a retract sent before a restart is done or lost: the translator serves one request
    # after the other, and refuses requests of an earlier scheduler once it knows a later one
    request = Request(int(ControlRequest.ACTION_SUPPORT), action, id=_ID)
    draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s)
    draft.watchdog = draft.watchdog.translator_is_there(draft.now_s)
    send(draft)


def send(draft: StateDraft) -> None:
    """Send the actions that the watchdog requires."""
    while True:
        draft.watchdog, action = draft.watchdog.next_action(draft.microscope)
        if action is None:
            return
        request = Request(int(ControlRequest.ACTION), action)
        draft.forwarder, job = draft.forwarder.ask_own(request, draft.now_s)
        if job is None:
            draft.watchdog = draft.watchdog.unsent(draft.now_s)
            return
        draft.limits = draft.limits.sending("", request, draft.now_ns)


def leave_to_person(draft: StateDraft) -> None:
    """Drop what the watchdog would send: the person at the microscope sees to the tip."""
    draft.forwarder, unsent = draft.forwarder.without_own_actions()
    draft.watchdog = draft.watchdog.left_to_person(is_unsent=unsent)


def settle(draft: StateDraft, job: ForwardedRequest, end: ForwardOutcome, response: Response) -> None:
    """Process the translator's answer to a safety command, or the failure to get an answer."""
    subject, now_s = str(job.request.subject), draft.now_s
    if end is ForwardOutcome.LATE:
        if response.ok and job.request.kind == ControlRequest.ACTION:
            draft.watchdog = draft.watchdog.done_late(subject)
        return
    if job.request.kind == ControlRequest.ACTION_SUPPORT:
        is_refused = response.code == ControlResponse.ACTION_NOT_SUPPORTED
        if response.ok or is_refused:
            draft.watchdog = draft.watchdog.with_retract(is_supported=not is_refused)
        return
    if not draft.forwarder.up:
        draft.watchdog = draft.watchdog.unsent(now_s)
        if draft.panel.why:
            leave_to_person(draft)
        return
    is_retract = draft.watchdog.tip.duty is TipDuty.ASKED
    draft.watchdog, result = draft.watchdog.answered(response.code, draft.microscope, now_s)
    if is_retract and result is SafetyResult.DONE:
        draft.microscope = draft.microscope.with_tip(away=True)
    # refused: it is over already, or has failed; the translator has withdrawn the tip then
    if subject == names.RELEASE_Z and result is not SafetyResult.AGAIN:
        draft.microscope = draft.microscope.holding_z(subject)
    if draft.panel.why:  # a person acted at the microscope meanwhile
        leave_to_person(draft)
    send(draft)
    if result is SafetyResult.DONE:
        draft.log("INFO", f"{subject}: done")
    elif result is SafetyResult.FAILED:
        due_s = draft.watchdog.due_s
        again = (
            ""
            if due_s is None
            else f"; it is asked again in {due_s - now_s:.0f} s, unless a component or a person takes over"
        )
        draft.log("ERROR", f"the microscope does not {subject}: {response.reason or response.code}{again}")
