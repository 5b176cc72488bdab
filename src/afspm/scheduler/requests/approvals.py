"""Approvals of agents in a step of the scheduler: a person's decision, and the requests that are sent under it."""

from __future__ import annotations

import math

from afspm.model import ControlRequest, ControlResponse, ProbePosition, Request, Response, ScopeState
from afspm.model.geometry import XY
from afspm.model.microscope_status import STARTS, STOPS, MicroscopeStatus
from afspm.scheduler.control import control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, ControlInput
from afspm.scheduler.coordinate_frame import MappedRequest
from afspm.scheduler.events import RequestIn
from afspm.scheduler.publishing.own_packets import publish
from afspm.scheduler.requests import answers
from afspm.scheduler.requests.forwarder import ForwardedRequest
from afspm.scheduler.safety import safety_commands
from afspm.scheduler.safety.grants import limits_digest
from afspm.scheduler.state import SchedulerState, StateDraft
from afspm.wire.messages import APPROVALS

_ORIGIN = Request(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.0)))


def decide(draft: StateDraft, event: RequestIn) -> None:
    """Process a person's approval or revocation; an agent left without an approval loses control."""
    grant = event.request.subject
    draft.grants, why = draft.grants.given(event.name, grant, draft.now_ns, offset_m(draft))
    if why:
        answers.answer(draft, event, ControlResponse.FAILURE, why)
        return
    draft.log("INFO", f"{event.name} {'revoked the approvals of' if grant.revokes else 'approved'} {grant.agent}")
    if not draft.grants.has_approval(grant.agent, draft.now_ns):
        control_change.decide(draft, ControlInput(ArbitrationEvent.REVOKED, grant.agent))
    if grant.revokes:
        end(draft)
    answers.answer(draft, event, ControlResponse.SUCCESS)


def end(draft: StateDraft) -> None:
    """Stop a measurement whose approval has run out; an agent in control without any approval left loses control."""
    holder = draft.control.holder
    if holder is not None and (ends_ns := draft.grants.ends_ns(holder)) is not None and draft.now_ns >= ends_ns:
        draft.grants = draft.grants.without(holder)
        draft.log("WARNING", f"the approval of {holder} has run out")
        control_change.decide(draft, ControlInput(ArbitrationEvent.REVOKED, holder))
    until_ns, stop = measurement_ends_ns(draft), _stop(draft)
    if stop is None or until_ns is None or draft.now_ns < until_ns:
        return
    who = draft.grants.book.measurement.who
    draft.grants = draft.grants.measured()
    stopping = draft.watchdog.stopping(stop)
    if stopping is not draft.watchdog:  # the end of control has not stopped it already
        draft.log("WARNING", f"the approval under which {who} measures has run out: {stop} is sent to the microscope")
        draft.watchdog = stopping
        safety_commands.send(draft)


def measurement_ends_ns(state: SchedulerState | StateDraft) -> int | None:
    """Return the experiment time at which the approval of the running measurement runs out; None: it needs none."""
    measurement = state.grants.book.measurement
    return measurement.until_ns if measurement.who and _stop(state) is not None else None


def _stop(state: SchedulerState | StateDraft) -> str | None:
    # None also while the controller is lost: the measurement is stopped once the controller is back
    return state.watchdog.to_stop(state.forwarder.action_in_flight, state.microscope)


def _may_measure(draft: StateDraft) -> bool:
    # packets of older states may come after the answer to a start
    scope = draft.microscope
    states = {scope.risk.state, *scope.possible_states(draft.now_s)}
    return not STOPS.keys().isdisjoint(states) or draft.forwarder.action_in_flight in STARTS


def state_changed(draft: StateDraft, before: MicroscopeStatus) -> None:
    """Forget the newest measurement of an agent once it has ended, or once another client or a person measures."""
    state, flight = draft.microscope.state, draft.forwarder.flight
    if not _may_measure(draft):
        draft.grants = draft.grants.measured()
    # not after a loss of the controller: its measurement may have gone on
    elif before.state is ScopeState.FREE and state in STOPS and state not in before.possible_states(draft.now_s):
        if flight is not None and flight.request.kind == ControlRequest.ACTION:
            draft.grants = draft.grants.measuring(flight.client, flight.request)
        else:  # begun at the panel
            draft.grants = draft.grants.measured()


def publish_changes(draft: StateDraft) -> None:
    """Publish the approvals if this step changed them."""
    book, before = draft.grants.book, draft.before.grants.book
    if book is not before and (now := book.approvals()) != before.approvals():
        publish(draft, APPROVALS.name, draft.env.codec.encode(now))


def facts(draft: StateDraft) -> dict[str, object]:
    """Return the digest of the limits and the coordinate offset that a preflight is valid for.

    Returns:
        `limits`, and `offset_m` as [x, y] in m (None: no offset); empty without agents.
    """
    if not draft.env.settings.rules.agents:
        return {}
    offset = offset_m(draft)
    return {"limits": limits_digest(draft.env.settings.limits), "offset_m": None if offset is None else list(offset)}


def offset_m(draft: StateDraft) -> XY | None:
    """Return the origin of component coordinates in microscope coordinates, in m.

    Returns:
        None if both are the same; NaN while the frame can't map.
    """
    if not draft.frame.maps(draft.now_ns):
        return None
    _, mapped = draft.frame.outgoing("", _ORIGIN, draft.now_ns)
    # NaN where the frame can't map now: then no approval is fresh
    xy_m = mapped.request.subject.xy_m if isinstance(mapped, MappedRequest) else (math.nan, math.nan)
    return (float(xy_m[0]), float(xy_m[1]))


def refusal(draft: StateDraft, job: ForwardedRequest) -> Response | None:
    """Return the refusal of a command without an approval or outside the limits of its role; None if it may be sent."""
    until_s = draft.lease.asked_until_s()
    # a frozen scheduler finds the request and the end of the lease at the same time
    if draft.env.settings.rules.is_agent(job.client) and until_s is not None and draft.now_s > until_s:
        return Response(int(ControlResponse.PARAM_ERROR), b"", f"the lease of {job.client} has ended", job.request.id)
    return draft.grants.refused(job.client, job.request, draft.now_ns, offset_m(draft), draft.limits.state)


def sending(draft: StateDraft, job: ForwardedRequest) -> None:
    """Count a command, about to be sent, against its approval."""
    draft.grants = draft.grants.sending(
        job.client, job.request, draft.now_ns, offset_m(draft), is_measuring=_may_measure(draft)
    )


def done(draft: StateDraft, job: ForwardedRequest) -> None:
    """Store the place that a successful command has set, and remove a completed plan."""
    draft.grants = draft.grants.done(job.client, job.request)
