"""A request from its arrival to its answer, in five stages, from top to bottom of this module.

| stage | decided | by |
| --- | --- | --- |
| 1. admitted | at arrival | session, idempotency |
| 2. authorised | at arrival, and again when it is sent | the arbitration table |
| 3. queued | at arrival | the forwarder: one line to the translator, in which the clients take turns |
| 4. within limits | when its turn comes, right before it is sent | limits, coordinate frame, the microscope itself |
| 5. settled | at the answer, or when the answer is overdue | the translator, or a timeout |

No request is executed twice, and every request gets an answer if its client stays connected.

**Why limits are decided at the fourth stage.** Limits compare a request with values in force, and earlier requests in
the queue change these. So a command is decided when its turn comes: no other command is on its way, all earlier
commands have settled, and the scheduler first reads the values from the microscope. A command of unknown outcome needs
no special case: the values that it may have changed are read before the next command that depends on them; if a value
can't be read, that command is refused. An overdue command may still be carried out. Since the translator serves one
request after the other, a value in a later answer is newer. A turn takes up to three steps: values are read, the
microscope is moved to the mapped place, values are read again. Meanwhile read-only requests pass, and the scheduler's
own requests (`safety_commands`) always go first.
"""

from __future__ import annotations

import json

from afspm.basics.errors import InvalidValue
from afspm.basics.frozen import replace
from afspm.model import (
    CLOCK_REQUEST,
    GRANT_REQUEST,
    HAS_ENDED,
    LEASE_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    ProbePosition,
    Request,
    Response,
    ResponseDetail,
    component_of,
    names,
)
from afspm.model.idempotency_cache import TOO_OLD, RequestStatus
from afspm.model.microscope_status import feedback_of
from afspm.model.requests import (
    AS_PLANNED_REQUEST,
    COMPARE_REQUEST,
    KEEP_REQUEST,
    OTHER_RUN_RESPONSE,
    RETURN_REQUEST,
    Settings,
)
from afspm.model.sessions import Hearing, run_of
from afspm.scheduler.control import control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, ControlChange, ControlInput, Rules, reason, row_for
from afspm.scheduler.coordinate_frame import MappedRequest
from afspm.scheduler.events import FrameAnswered, Reply, RequestIn
from afspm.scheduler.publishing import own_packets as publishing
from afspm.scheduler.publishing.event_log import SCHEDULER
from afspm.scheduler.requests import answers, approvals, instrument_requests, lending
from afspm.scheduler.requests.forwarder import (
    AskForFrame,
    CompareForTurn,
    ForwardedRequest,
    ForwardOutcome,
    MoveForTurn,
    OwnPurpose,
    ReadAhead,
    ReadForOrder,
    ReadForTurn,
    SetForTurn,
    SettledRequest,
)
from afspm.scheduler.requests.pending_requests import PrePositioner, Turn
from afspm.scheduler.safety import present_state, safety_commands
from afspm.scheduler.safety.forbidden_states import STARTED
from afspm.scheduler.safety.limit_checker import is_get
from afspm.scheduler.safety.movers import MoverState
from afspm.scheduler.state import StateDraft

_ACTION, _PARAM = int(ControlRequest.ACTION), int(ControlRequest.PARAM)
_ANOTHER_RUN = "this is the scheduler of another run: two experiments have the same address"
_TWO_OF_A_NAME = "another component is connected as {name}; each needs a name of its own"
_LACKING = (ControlResponse.PARAM_NOT_SUPPORTED, ControlResponse.CMD_NOT_SUPPORTED)  # this parameter, or all
_CONTROL_EVENTS = {
    int(ControlRequest.REQUEST_CTRL): ArbitrationEvent.REQUEST_CONTROL,
    int(ControlRequest.RELEASE_CTRL): ArbitrationEvent.RELEASE_CONTROL,
    int(ControlRequest.ADD_EXP_PRBLM): ArbitrationEvent.FLAG,
    int(ControlRequest.RMV_EXP_PRBLM): ArbitrationEvent.CLEAR,
    int(ControlRequest.SET_CONTROL_MODE): ArbitrationEvent.SET_MODE,
    int(ControlRequest.END_EXPERIMENT): ArbitrationEvent.END,
}
"""The requests about control, problems, mode and end, by number, each with its event in the arbitration table."""


def handle(draft: StateDraft, event: RequestIn) -> None:
    """Run the stages of a request that are decided at its arrival."""
    if event.heard_s < 0.0:
        event = replace(event, heard_s=draft.now_s)
    event, why = _by_canonical_name(draft, event)
    if not admit(draft, event):
        return
    if why:
        answers.answer(draft, event, ControlResponse.PARAM_ERROR, why)
    elif authorise(draft, event):
        if event.request.kind == _ACTION and event.request.subject == names.TIP_IS_CLEAR:
            _take_word(draft, event)
        else:
            enqueue(draft, event)


def _take_word(draft: StateDraft, event: RequestIn) -> None:
    if draft.panel.tip.engaged is not False or draft.microscope.lost_since_s is not None:
        why = "the tip is not shown as withdrawn: withdraw it, and move it away"
        answers.answer(draft, event, ControlResponse.ACTION_ERROR, why)
        return
    draft.limits = draft.limits.with_movers(lambda state: replace(state, cleared_by=event.name, cleared_s=draft.now_s))
    draft.log("WARNING", f"{event.name} says that the tip is far enough from the sample for lateral moves")
    answers.answer(draft, event, ControlResponse.SUCCESS)


def _by_canonical_name(draft: StateDraft, event: RequestIn) -> tuple[RequestIn, str]:
    # before all stages, so that no limit, rule or approval is passed under another name; also why it can't be
    asked, alias = event.request.subject, names.BIAS_OF_SAMPLE
    parameters = asked.parameters if isinstance(asked, Settings) else (asked,) if isinstance(asked, Parameter) else ()
    if all(one.name != alias for one in parameters):
        return event, ""
    try:
        renamed = tuple(map(draft.env.settings.limits.bias.canonical, parameters))
    except InvalidValue as error:
        return event, error.what
    subject: Settings | Parameter = renamed[0]
    if isinstance(asked, Settings):
        named = (replace(one, parameter=name) for one, name in zip(asked.settings, renamed, strict=True))
        subject = replace(asked, settings=tuple(named))
    payload = draft.env.codec.encode(subject)
    return replace(event, request=replace(event.request, subject=subject, payload=payload, alias=alias)), ""


# --- 1. admitted: the name belongs to the peer, and the request is new -----------------------------------------------


def admit(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether a request goes on to the next stage; otherwise it was answered or refused, or waits."""
    if event.request.kind in _CONTROL_EVENTS and (barrier := draft.barrier.keep(event)) is not None:
        draft.barrier = barrier
        return False
    if not _owns_its_name(draft, event):
        return False
    outcome = draft.idempotency.look_up(event.name, event.request)
    return outcome is None or not _answers_repeated(draft, event, outcome)


def _owns_its_name(draft: StateDraft, event: RequestIn) -> bool:
    name, request_id, run = event.name, event.request.id, draft.env.settings.run.name
    if not name:
        answers.refuse_peer(draft, event, "a client without a name: set the socket's identity to the component's name")
        return False
    if event.user is not None and event.user != component_of(name):
        answers.refuse_peer(draft, event, f"this is the key of {event.user}, not of {name}")
        return False
    # a component of another run at the same address must not act here
    if run and run_of(name, request_id) not in ("", run):
        answers.refuse_peer(draft, event, _ANOTHER_RUN, OTHER_RUN_RESPONSE)
        return False
    pending, known = draft.pending, draft.peers.sessions
    sessions, hearing = known.hear(event.connection, name, request_id, draft.now_s)
    if sessions is not known:
        draft.peers = replace(draft.peers, sessions=sessions)
    if hearing is Hearing.UNCLEAR and name not in pending.unclear and event.connection not in pending.refused:
        draft.pending = pending.with_unclear(event, draft.now_s)
    elif hearing in (Hearing.TAKEN, Hearing.UNCLEAR):
        refuse_second(draft, event)
    return hearing is Hearing.ACCEPTED


def refuse_second(draft: StateDraft, event: RequestIn) -> None:
    """Refuse a second process with the same name."""
    answers.refuse_peer(draft, event, _TWO_OF_A_NAME.format(name=event.name))


def _answers_repeated(draft: StateDraft, event: RequestIn, outcome: RequestStatus | Response) -> bool:
    name, request = event.name, event.request
    if isinstance(outcome, Response):
        draft.effects.append(Reply(event.connection, name, outcome, request.kind))
        return True
    if outcome is RequestStatus.PENDING:
        return True  # its answer will go to the newest connection
    if (waiting := draft.forwarder.asked_again(name, request.id, draft.now_s)) is not None:
        draft.forwarder = waiting
        draft.idempotency = draft.idempotency.noted(name, request, RequestStatus.PENDING)
        return True
    if outcome is RequestStatus.FORGOTTEN:
        answers.reply(draft, event, _unknown(request, TOO_OLD))
        return True
    # sent again with its id: the translator knows the outcome, and does not execute it twice
    if draft.control.holder == name or reads(request):
        return False
    answers.reply(draft, event, _unknown(request, "it was sent once, and is not sent again"))
    return True


def _unknown(request: Request, why: str) -> Response:
    detail = ResponseDetail.OUTCOME_UNKNOWN
    return Response(int(ControlResponse.NO_RESPONSE), b"", f"outcome unknown: {why}", request.id, detail)


# --- 2. authorised: the scheduler answers itself, or the client may command the microscope --------------------------


def authorise(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether to forward a request; if not, the scheduler answers it, now or when the end is complete."""
    kind, subject = event.request.kind, event.request.subject
    if why := draft.grants.refused_at_arrival(event.name, event.request, draft.now_ns):
        answers.answer(draft, event, ControlResponse.FAILURE, why)
        return False
    if (report := instrument_requests.report_in(draft, event)) is not None and not draft.control.ended:
        instrument_requests.take_report(draft, event, report, _not_allowed_now)
    elif kind == RELAY_REQUEST:  # also after the end: final process states belong in the record
        publishing.publish_for_process(draft, event)
    elif draft.control.ended:
        control_change.answer_unless_ending(
            draft, event, ControlResponse.FAILURE, HAS_ENDED, ResponseDetail.EXPERIMENT_ENDED
        )
        if kind == ControlRequest.ADD_EXP_PRBLM:  # too late to be flagged, but the record must show it
            publishing.publish_entries(draft)
    elif kind == RESTART_REQUEST:
        publishing.order_restart(draft, event)
    elif kind == CLOCK_REQUEST:
        _answer_clock_request(draft, event)
    elif kind == LEASE_REQUEST:
        _renew_lease(draft, event)
    elif kind == GRANT_REQUEST:
        approvals.decide(draft, event)
    elif kind == RETURN_REQUEST:
        return lending.take_return(draft, event)
    elif kind in (KEEP_REQUEST, AS_PLANNED_REQUEST):
        why = lending.refusal_to_overrule(draft, event)
        answers.answer(draft, event, ControlResponse.FAILURE if why else ControlResponse.SUCCESS, why)
    elif kind <= 0 or kind == COMPARE_REQUEST:
        why = f"there is no request with the number {kind}"
        answers.answer(draft, event, ControlResponse.CMD_NOT_SUPPORTED, why)
    elif remedy := _refusal_to_continue(draft, event):
        answers.answer(draft, event, ControlResponse.FAILURE, remedy)
    elif (control_event := _CONTROL_EVENTS.get(kind)) is not None:
        return control_change.decide(draft, ControlInput(control_event, event.name, int(subject or 0)), event)
    else:
        wanted = _microscope_event(event.request, draft.env.settings.rules)
        return control_change.decide(draft, ControlInput(wanted, event.name), event)
    return False


def _refusal_to_continue(draft: StateDraft, event: RequestIn) -> str:
    # the translator publishes tip and feedback whenever they change, so the newest are in force
    kind, mode = event.request.kind, event.request.subject
    if kind != ControlRequest.SET_CONTROL_MODE or mode != ControlMode.AUTOMATED:
        return ""
    if draft.control.mode is not ControlMode.MANUAL:
        return ""
    if draft.env.settings.rules.is_agent(event.name):
        return "a person lets the run continue, and never an agent"
    is_process = draft.peers.supervisors.starts_of(event.name) is not None  # a person has a name of the form "page:Ada"
    if draft.panel.why and is_process and draft.env.settings.rules.roles.set_mode is None:
        return f"a person lets the run continue, unless [control.roles] set_mode names {event.name}"
    if draft.panel.outside and not draft.panel.tip.remedy:  # a value may have been set back unseen
        for name in draft.panel.outside:
            _read(draft, name, ReadAhead(name))
    return draft.panel.remedy


def _microscope_event(request: Request, rules: Rules) -> ArbitrationEvent:
    if reads(request):
        return ArbitrationEvent.READ
    if request.kind == _ACTION and request.subject in (names.FEEDBACK_MAY_BE_OFF, names.TIP_IS_CLEAR):
        return ArbitrationEvent.FEEDBACK_OFF
    is_adjustable = request.kind == _PARAM and request.subject.name in rules.adjustable
    return ArbitrationEvent.ADJUST if is_adjustable else ArbitrationEvent.COMMAND


def _renew_lease(draft: StateDraft, event: RequestIn) -> None:
    # successes are not in the event log: a client of the gateway renews its lease again and again
    name, holder = event.name, draft.control.holder
    if name != holder:
        why = f"{name} is not in control, {holder or 'no component'} is"
        answers.answer(draft, event, ControlResponse.NOT_IN_CONTROL, why)
        return
    draft.lease = draft.lease.asked(event.request.subject, draft.now_s)
    response = Response(int(ControlResponse.SUCCESS), b"", "", event.request.id)
    draft.effects.append(Reply(event.connection, name, response, LEASE_REQUEST))


def _answer_clock_request(draft: StateDraft, event: RequestIn) -> None:
    # not in the event log: supervisors and starting processes send this request all the time
    run = draft.env.settings.run
    common = {
        "run": run.name,
        "simulated": run.simulated,
        "now_ns": draft.now_ns,
        "in_use": _reason_to_stay(draft),
        **approvals.facts(draft),
    }
    metadata = json.dumps({**run.clock, **common, "versions": dict(run.versions)}).encode()
    response = Response(int(ControlResponse.SUCCESS), metadata, "", event.request.id)
    draft.effects.append(Reply(event.connection, event.name, response, CLOCK_REQUEST))


def _reason_to_stay(draft: StateDraft) -> str:
    # why a supervisor with nothing left to run may not end the experiment now; empty: it may
    if draft.control.mode is ControlMode.MANUAL:
        return "the mode is MANUAL"
    return f"{draft.control.holder} is in control" if draft.control.holder else ""


# --- 3. queued: the request waits -----------------------------------------------------------------------------------


def enqueue(draft: StateDraft, event: RequestIn) -> None:
    """Queue a request for the translator or an instrument, or refuse a request that can't be sent now.

    A read of an instrument's parameter is answered at once, if the last reading is new enough.
    """
    name, request, is_command = event.name, event.request, not reads(event.request)
    if is_command and (why := _refusal_for_tip(draft)) is not None:
        answers.answer(draft, event, ControlResponse.NOT_FREE, why)
        return
    is_repeated = draft.idempotency.look_up(name, request) is RequestStatus.UNKNOWN
    takes_turn = is_command or _needs_second_electrode(draft, request)
    job = ForwardedRequest.of(event, command=takes_turn, is_repeated=is_repeated)
    if instrument_requests.is_for_instrument(draft, event):
        instrument_requests.ask(draft, event, job, _not_allowed_now)
        return
    known = draft.forwarder.flooders
    draft.forwarder, refused = draft.forwarder.ask(job, draft.now_s)
    if name in draft.forwarder.flooders and name not in known:
        most = draft.forwarder.most_of_client
        why = (
            f"{name} asks faster than the translator answers: {most} of its requests wait, and further ones are refused"
        )
        draft.log("WARNING", f"{why}; let it wait for each answer")
    if refused is None:
        draft.idempotency = draft.idempotency.noted(name, request, RequestStatus.PENDING)
    else:
        answers.answer_unsent(draft, job, refused.response)


# --- 4. within limits: decided when its turn comes, with the microscope at its place --------------------------------


def send_next(draft: StateDraft) -> None:
    """Decide and send waiting requests in their order, until a request is in flight."""
    turn = draft.pending.turn
    if turn is not None and draft.forwarder.waiting(turn.number) is None:
        draft.pending = replace(draft.pending, turn=None)  # it was called back, or its deadline has passed
    send_own(draft)
    while draft.forwarder.is_free and (job := _next_job(draft)) is not None:
        _decide(draft, job)
        send_own(draft)


def send_own(draft: StateDraft) -> None:
    """Send the first of the scheduler's own requests, which need no decision."""
    forwarder = draft.forwarder
    if forwarder.is_free and forwarder.own:
        draft.forwarder = forwarder.sent(forwarder.own[0], draft.now_s)


def _next_job(draft: StateDraft) -> ForwardedRequest | None:
    others, queue, turn = lending.before_returns(draft), draft.forwarder.queue, draft.pending.turn
    if turn is None:
        return next(iter([*others, *queue]), None)
    if turn.is_ready(draft.microscope, draft.now_s, draft.now_ns):
        return draft.forwarder.waiting(turn.number)
    # reads change nothing, so they need not wait for the turn of a command
    return next((job for job in queue if not job.command), None)


def _decide(draft: StateDraft, job: ForwardedRequest) -> None:
    if not job.command:
        if not isinstance(mapped := _mapped(draft, job), Response):
            _send(draft, job, mapped)
        return
    # authorised again: control may have changed while the command waited; who has lent may return without control
    if job.request.kind != RETURN_REQUEST and (refusal := _not_allowed_now(draft, job)) is not None:
        answers.take_off(draft, job, refusal)
        return
    if _knows_no_danger(draft, job):
        draft.pending = replace(draft.pending, turn=None)
        # the death of its earlier life is decided now: the tip is retracted, and this command is called back
        control_change.decide(draft, ControlInput(ArbitrationEvent.DEAD, job.client))
        return
    if lending.refuses_forgotten(draft, job):
        return
    turn = draft.pending.turn or Turn(job.number)
    if lending.takes_turn(draft, job) if turn.lending is None else not turn.lending.is_done:
        advanced = lending.advance(draft, job, turn)
        if advanced is None:
            return
        turn = advanced
    if turn.awaited is None and _starts_reads(draft, job, turn):
        return
    _apply_read_values(draft, turn)
    if (refusal := answers.refusal_for_second_electrode(job.request, turn.values)) is not None:
        _refuse(draft, job, refusal)
        return
    mapped = _mapped(draft, job)
    if isinstance(mapped, Response) or not _is_within_limits(draft, job, mapped, turn):
        return
    if not reads(job.request) and (refusal := approvals.refusal(draft, job)) is not None:
        _refuse(draft, job, refusal)
        return
    if job.request.kind == _ACTION:
        if turn.move is None and _starts_move(draft, job, turn):
            return
        if (refusal := draft.limits.check_place(job.request)) is not None:
            _refuse(draft, job, refusal)
            return
        if why := draft.instruments.refusal(str(job.request.subject), draft.now_s, draft.now_ns):
            # not free: its client waits, and tries again
            answers.take_off(draft, job, Response(int(ControlResponse.NOT_FREE), b"", why, job.request.id))
            return
    _send(draft, job, mapped)


def _send(draft: StateDraft, job: ForwardedRequest, mapped: MappedRequest | None) -> None:
    name, request = job.client, job.request
    sent_ns = draft.event_log.sent_ns(name, request, draft.now_ns)
    is_by_hand = draft.control.mode is ControlMode.MANUAL
    job = job._replace(mapped=mapped, states_seen=draft.microscope.states_seen, sent_ns=sent_ns, is_by_hand=is_by_hand)
    draft.event_log = draft.event_log.sending(name, request, sent_ns)
    if job.command:
        draft.pending = replace(draft.pending, turn=None)
    if job.command and not reads(request):
        draft.limits = draft.limits.sending(
            name, job.outgoing, draft.now_ns, _names_meant(job), is_repeated=job.is_repeated
        )
        present_state.sending(draft, job.outgoing)
        approvals.sending(draft, job)
        _restart_lease(draft, name)
    draft.forwarder = draft.forwarder.sent(job, draft.now_s)
    if not request.id:
        return
    # known after a restart: before an action that was done already the microscope must not be moved, and a repeated use
    # must not count twice
    is_kept = request.kind == _ACTION and draft.frame.is_moving
    if is_kept or (job.command and draft.limits.counts(job.outgoing)):
        draft.idempotency = draft.idempotency.sent(name, request)
    elif mapped is not None:
        draft.save()  # the frame with this mapping: a retry after a kill must send the same bytes


def _refuse(draft: StateDraft, job: ForwardedRequest, refusal: Response) -> None:
    refusal = answers.with_alias(draft, job.request, refusal)
    answers.log_refusal(draft, job.client, refusal)
    answers.take_off(draft, job, refusal)


def _restart_lease(draft: StateDraft, client: str) -> None:
    # an adjustment by a person beside the holder is no sign of life of the holder
    if client == draft.control.holder:
        draft.lease = draft.lease.commanded(draft.now_ns, draft.now_s)


def _not_allowed_now(draft: StateDraft, job: ForwardedRequest) -> Response | None:
    rules = draft.env.settings.rules
    ask = ControlInput(_microscope_event(job.request, rules), job.client)
    row = row_for(draft.control, ask, rules)
    if ControlChange.FORWARD not in row.do:
        code = ControlResponse.NOT_IN_CONTROL if row.response is None else row.response
        return Response(int(code), b"", reason(row, draft.control, ask, rules), job.request.id)
    if not reads(job.request) and (why := _refusal_for_tip(draft)) is not None:
        return Response(int(ControlResponse.NOT_FREE), b"", why, job.request.id)
    return None


def _knows_no_danger(draft: StateDraft, job: ForwardedRequest) -> bool:
    # the holder was restarted, and commands with the feedback off as its earlier life left it (decision 0001); one that
    # sets the feedback or retracts knows of it
    if job.client != draft.control.holder or not draft.microscope.endangered_by_feedback or reads(job.request):
        return False
    retracts = job.request.kind == _ACTION and job.request.subject == draft.watchdog.settings.retract
    feedback = feedback_of(job.request) if job.request.kind != _ACTION else None
    is_aware = retracts or (feedback is not None and feedback.on is not None)
    return not is_aware and control_change.is_other_life(draft, draft.peers.sessions.token(job.client))


def _refusal_for_tip(draft: StateDraft) -> str | None:
    # a component that does not know of the danger must not move, pulse or scan with such a tip (decision 0001)
    dog, sees_to_tip = draft.watchdog, draft.control.sees_to_tip
    if dog.tip.may_come and draft.forwarder.up:
        return "a retract of before the scheduler's restart may still be carried out, until the translator answers"
    if not (dog.owes_retract and draft.forwarder.up):
        if not dog.left_to_people or sees_to_tip:
            return None
        return "the tip was in danger; a person brings it back to the surface, then clears device-malfunction"
    if not dog.put_off:
        return "the tip is being retracted, as it was left in danger"
    if sees_to_tip:
        return None
    return (
        "the tip is in danger and not retracted yet; until then only components that solve device-malfunction may act"
    )


def _mapped(draft: StateDraft, job: ForwardedRequest) -> MappedRequest | Response | None:
    draft.frame, outgoing = draft.frame.outgoing(job.client, job.request, draft.now_ns)
    if isinstance(outgoing, Response):
        _refuse(draft, job, outgoing)
    return outgoing  # None: it is sent as it is


def _is_within_limits(draft: StateDraft, job: ForwardedRequest, mapped: MappedRequest | None, turn: Turn) -> bool:
    check, now_ns = draft.limits.check, draft.now_ns
    if mapped is None:
        refusal = check(job.client, job.request, now_ns, is_repeated=job.is_repeated)
    else:
        refusal = check(job.client, mapped.request, now_ns, mapped.names, is_repeated=job.is_repeated)
        if refusal is not None:
            refusal = replace(refusal, reason=f"{refusal.reason}; {mapped.places_text}")
    if refusal is None and draft.limits.limits.forbid:
        request = job.request if mapped is None else mapped.request
        refusal = draft.limits.check_forbidden(request, present_state.present_state(draft, turn.values))
    if refusal is not None:
        _refuse(draft, job, refusal)
    return refusal is None


def _starts_reads(draft: StateDraft, job: ForwardedRequest, turn: Turn) -> bool:
    needed = draft.limits.depends_on(job.request, is_mapped=draft.frame.maps(draft.now_ns))
    second = [names.SAMPLE_BIAS] if _needs_second_electrode(draft, job.request) else []
    needed = list(dict.fromkeys((*needed, *draft.grants.depends_on(job.client, job.request), *second)))
    if not needed:
        return False
    draft.pending = replace(draft.pending, turn=turn.reading(frozenset(needed)))
    for name in needed:
        _read(draft, name, ReadForTurn(job.number, name))
    return True


def _needs_second_electrode(draft: StateDraft, request: Request) -> bool:
    return bool(request.alias) and draft.env.settings.limits.bias.may_have_second


def _take_read_value(draft: StateDraft, number: int, name: str, response: Response) -> None:
    turn, job = draft.pending.turn, draft.forwarder.waiting(number)
    if turn is None or job is None or turn.number != number:
        return  # it was called back
    if response.code == ControlResponse.NO_RESPONSE:
        answers.take_off(draft, job, _failed_before(response))
    elif response.code in _LACKING:
        draft.limits = draft.limits.forget(name)
        draft.pending = replace(draft.pending, turn=turn.lacks(name))
    else:
        answered = draft.env.codec.decode_parameter(response.payload) if response.ok and response.payload else None
        answered = answered if answered is not None and answered.name == name else None
        draft.pending = replace(draft.pending, turn=turn.was_read(name, answered))


def _apply_read_values(draft: StateDraft, turn: Turn) -> None:
    # only now: packets that arrived during the reads may be older than the values read
    if not turn.values:
        return
    if draft.microscope.is_free:
        draft.limits = draft.limits.with_movers(MoverState.free)
    draft.limits = draft.limits.was_read(turn.values, draft.now_ns)
    position = draft.limits.state.position
    if position.region is not None and names.SCAN_SIZE_X in turn.values:
        draft.frame = draft.frame.in_force(position.region, draft.now_ns)
    if position.probe_m is not None and names.PROBE_POS_X in turn.values:
        draft.frame = draft.frame.in_force(ProbePosition(position.probe_m), draft.now_ns)


def _failed_before(response: Response) -> Response:
    return replace(response, reason=f"not sent: the read or move before it failed ({response.reason})")


def read_ahead(draft: StateDraft) -> None:
    """Read the parameters with a limited rate, so that their rates can be checked later."""
    for name in draft.limits.to_be_known():
        _read(draft, name, ReadAhead(name))


def _read(draft: StateDraft, name: str, purpose: OwnPurpose) -> None:
    request = Request(_PARAM, Parameter(name))
    draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s, purpose)


def _starts_move(draft: StateDraft, job: ForwardedRequest, turn: Turn) -> bool:
    if draft.idempotency.was_sent(job.client, job.request):
        return False
    draft.frame, move = draft.frame.move_before(str(job.request.subject), draft.now_ns)
    if move is None:
        return False
    if not _is_within_limits(draft, job, move, turn):
        return True
    draft.limits = draft.limits.sending(job.client, move.request, draft.now_ns, ())
    present_state.sending(draft, move.request)
    draft.forwarder, own = draft.forwarder.ask_own(move.request, draft.now_s, MoveForTurn(job.number), move)
    assert own is not None  # the line is free
    own = own._replace(deadline_s=job.deadline_s)
    draft.pending = replace(draft.pending, turn=turn.moving(PrePositioner(own, draft.microscope.states_seen)))
    draft.save()  # the frame with this move: packets about it can then be mapped after a restart
    return True


def _take_move_result(draft: StateDraft, number: int, response: Response) -> None:
    turn, job = draft.pending.turn, draft.forwarder.waiting(number)
    if turn is None or turn.move is None or job is None or turn.number != number:
        return  # the action was called back
    if response.ok:
        draft.pending = replace(draft.pending, turn=replace(turn, move=turn.move.moved(draft.now_s)))
    elif response.code == ControlResponse.NO_RESPONSE:
        answers.take_off(draft, job, _failed_before(response))
    else:
        answers.take_off(draft, job, response)


# --- 5. settled: the translator has answered, or did not in time ----------------------------------------------------


def settle(draft: StateDraft, settled: SettledRequest) -> None:
    """Process the end of a request: remember its outcome, and answer the client."""
    job, end, response = settled.job, settled.end, settled.response
    if end in (ForwardOutcome.ANSWERED, ForwardOutcome.LATE):
        response = answers.with_id(response, job.request)
        if response.ok and (job.command or job.request.kind == _PARAM):
            response = _apply_success(draft, job, response)
            _look_at_value(draft, job, response)
            response = _as_asked(draft, job, response)
    # it may have been carried out: its values are read before the next request that depends on them
    if job.command and end is not ForwardOutcome.NOT_SENT and _is_unknown(response):
        draft.limits = draft.limits.unknown(job.outgoing)
    if end is not ForwardOutcome.NOT_SENT and not reads(job.request):
        draft.instruments = draft.instruments.changed(draft.now_s)
    if not job.client:
        _settle_own(draft, job, end, response)
    elif end is ForwardOutcome.NOT_SENT:
        answers.answer_unsent(draft, job, response)
    elif end is ForwardOutcome.ANSWERED and _was_not_sent(response):
        draft.idempotency = draft.idempotency.not_sent(job.client, job.request)
        answers.take_back(draft, job)
        answers.answer_job(draft, job, response)
    elif end is ForwardOutcome.LATE:
        _settle_late(draft, job, response)
    else:
        if end is ForwardOutcome.UNKNOWN and job.request.kind == _ACTION:
            _action_started(draft, job, is_certain=False)
        _track_feedback(draft, job, response)
        answers.finish(draft, job, response, _unknown_status(response))


def _as_asked(draft: StateDraft, job: ForwardedRequest, response: Response) -> Response:
    codec, bias = draft.env.codec, draft.env.settings.limits.bias
    answered = codec.decode_parameter(response.payload) if job.request.alias and response.payload else None
    if answered is None:
        return response
    try:
        return replace(response, payload=codec.encode(bias.of_sample(answered)))
    except InvalidValue as error:
        return replace(response, code=int(ControlResponse.PARAM_ERROR), payload=b"", reason=error.what)


def _look_at_value(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    # of a setting that a person has left outside the limits
    if job.request.kind == _PARAM and job.request.subject.name in draft.panel.outside and response.payload:
        answered = draft.env.codec.decode_parameter(response.payload)
        if answered is not None and answered.value is not None:
            draft.panel = draft.panel.with_change(answered.name, draft.limits.outside(answered))


def _settle_own(draft: StateDraft, job: ForwardedRequest, end: ForwardOutcome, response: Response) -> None:
    if not reads(job.request):
        answers.write_down(draft, SCHEDULER, job.request, response, job.heard_s)
    if job.purpose is None:
        safety_commands.settle(draft, job, end, response)
    elif end is not ForwardOutcome.LATE:  # after its timeout the purpose has ended already
        _serve_purpose(draft, job.purpose, response)


def _serve_purpose(draft: StateDraft, purpose: OwnPurpose, response: Response) -> None:
    match purpose:
        case ReadForTurn():
            _take_read_value(draft, purpose.number, purpose.name, response)
        case ReadForOrder():
            instrument_requests.take_read_value(draft, purpose, response, _not_allowed_now)
        case CompareForTurn():
            lending.take_compared(draft, purpose.number, response)
        case SetForTurn():
            lending.take_set(draft, purpose, response)
        case MoveForTurn():
            _take_move_result(draft, purpose.number, response)
        case AskForFrame():
            draft.raised.append(FrameAnswered(purpose.purpose, response))
        case ReadAhead() if not response.ok:
            draft.limits = draft.limits.forget(purpose.name)


def _settle_late(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    # the client has got "no response" already: only a retry under the same id gets this answer
    _track_feedback(draft, job, response)
    status = _unknown_status(response)
    draft.idempotency = draft.idempotency.noted(job.client, job.request, status or response)
    if status is None and not response.ok:
        answers.take_back(draft, job)
    answers.write_down(draft, job.client, job.request, response, job.heard_s, sent_ns=job.sent_ns, late=True)
    draft.log("WARNING", f"the translator answered {job.client} late; the answer is kept for its retry")


def _track_feedback(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    is_over = response.code == ControlResponse.ACTION_ERROR  # the translator has gone the way back by itself
    if is_over and job.request.kind == _ACTION and job.request.subject == names.RELEASE_Z:
        draft.microscope = draft.microscope.holding_z(names.RELEASE_Z)
    feedback = feedback_of(job.request)
    if feedback is None or feedback.on is not False or response.ok:
        return
    if response.code == ControlResponse.NO_RESPONSE:
        draft.microscope = draft.microscope.feedback_may_be_off()
    else:
        draft.microscope = draft.microscope.feedback_was_left()


def _apply_success(draft: StateDraft, job: ForwardedRequest, response: Response) -> Response:
    request, now_ns = job.request, draft.now_ns
    answered = None
    if request.kind == _PARAM and response.payload:
        answered = draft.env.codec.decode_parameter(response.payload)
    draft.limits = draft.limits.carried_out(job.outgoing, now_ns, answered, _names_meant(job), job.client)
    draft.frame = draft.frame.carried_out(job.outgoing, answered, now_ns)
    # not for the scheduler's own reads: limits are in the coordinates of the microscope
    is_asked = request.kind == _PARAM and bool(job.client)
    if is_asked and (mapped := draft.frame.answer(request, answered, now_ns)) is not None:
        response = replace(response, payload=draft.env.codec.encode(mapped))
    if request.kind == _ACTION:
        _action_started(draft, job, is_certain=True)
    if (feedback := feedback_of(request)) is not None:
        draft.microscope = draft.microscope.with_feedback(feedback)
        if feedback.on is not None and job.client and job.client == draft.control.holder:
            # from now on the restarted holder answers for the feedback itself
            draft.lease = replace(draft.lease, token=draft.peers.sessions.token(job.client) or draft.lease.token)
    if job.command:
        _restart_lease(draft, job.client)
        approvals.done(draft, job)
        if job.client:
            lending.decided(draft, job, answered)
        if job.is_by_hand and draft.control.mode is ControlMode.MANUAL:
            draft.by_hand = draft.by_hand.requested(request)
    return response


def _action_started(draft: StateDraft, job: ForwardedRequest, *, is_certain: bool) -> None:
    action = str(job.request.subject)
    if action in lending.MEASURES:
        lending.begun(draft, job.client)
    draft.watchdog = draft.watchdog.started(action, job.states_seen, draft.microscope)
    if (state := STARTED.get(action)) is not None:
        until_s = draft.now_s + draft.env.settings.control.request_timeout_s
        draft.microscope = draft.microscope.expecting(state, until_s=until_s)
    is_away = is_certain and action == draft.watchdog.settings.retract
    draft.microscope = draft.microscope.after_action(action, is_away=is_away)


def _names_meant(job: ForwardedRequest) -> tuple[str, ...] | None:
    # None: all parameters of the request
    return None if job.mapped is None else tuple(job.mapped.names)


def _is_unknown(response: Response) -> bool:
    return response.code == ControlResponse.NO_RESPONSE and response.detail is not ResponseDetail.NOT_SENT


def _was_not_sent(response: Response) -> bool:
    return response.code == ControlResponse.NO_RESPONSE and response.detail is ResponseDetail.NOT_SENT


def _unknown_status(response: Response) -> RequestStatus | None:
    # a request of unknown outcome is forwarded again: the translator knows its id, and may know the outcome by then
    return RequestStatus.UNKNOWN if response.code == ControlResponse.NO_RESPONSE else None


def reads(request: Request) -> bool:
    """Return whether a request is read-only."""
    if request.kind in (ControlRequest.ACTION_SUPPORT, COMPARE_REQUEST):
        return True
    return request.kind == _PARAM and is_get(request)
