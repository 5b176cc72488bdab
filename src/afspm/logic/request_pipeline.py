"""A request from being heard to being answered, in five stages, from top to bottom of this module.

Admitted (session, idempotency), authorised (arbitration), within limits, forwarded, settled. Nothing is done twice, and
every request gets an answer.
"""

from __future__ import annotations

import json
from functools import partial

from afspm.logic import answers, control_change, publishing, safety_commands
from afspm.logic.arbitration import ArbitrationEvent, ControlInput, Rules
from afspm.logic.coordinate_frame import MappedRequest
from afspm.logic.event_log import SCHEDULER
from afspm.logic.events import Reply, RequestIn
from afspm.logic.forwarder import ForwardedRequest, ForwardOutcome, OwnAnswer, SettledRequest
from afspm.logic.frozen import replace
from afspm.logic.idempotency_cache import RequestStatus
from afspm.logic.limit_checker import is_get
from afspm.logic.microscope_status import feedback_of
from afspm.logic.pending_requests import PendingRead, PrePositioner
from afspm.logic.sessions import Hearing, run_of
from afspm.logic.state import StateDraft
from afspm.model import (
    CLOCK_REQUEST,
    HAS_ENDED,
    LEASE_REQUEST,
    OTHER_RUN_RESPONSE,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    component_of,
)

_ACTION, _PARAM = int(ControlRequest.ACTION), int(ControlRequest.PARAM)
_ANOTHER_RUN = "this is the scheduler of another run: two experiments have the same address"
_TWO_OF_A_NAME = "another component is connected as {name}; each needs a name of its own"
_CONTROL_EVENTS = {
    int(ControlRequest.REQUEST_CTRL): ArbitrationEvent.REQUEST_CONTROL,
    int(ControlRequest.RELEASE_CTRL): ArbitrationEvent.RELEASE_CONTROL,
    int(ControlRequest.ADD_EXP_PRBLM): ArbitrationEvent.FLAG,
    int(ControlRequest.RMV_EXP_PRBLM): ArbitrationEvent.CLEAR,
    int(ControlRequest.SET_CONTROL_MODE): ArbitrationEvent.SET_MODE,
    int(ControlRequest.END_EXPERIMENT): ArbitrationEvent.END,
}
"""The requests that may change control, by their numbers. All others are for the microscope."""


def handle(draft: StateDraft, event: RequestIn) -> None:
    """Take a request through its stages, as far as it gets without waiting."""
    if event.heard_s < 0.0:
        event.heard_s = draft.now_s
    if admit(draft, event) and authorise(draft, event):
        pass_on(draft, event)


def pass_on(draft: StateDraft, event: RequestIn, deadline_s: float = 0.0) -> None:
    """Check a request that is authorised, and forward it.

    Args:
        deadline_s: of one that has waited for what its limits depend on; 0: it has not.
    """
    if (job := check_limits(draft, event, deadline_s)) is not None:
        forward(draft, job)


# --- 1. admitted: the peer may speak for its name, and the request is new -------------------------------------------


def admit(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether a request is new and to be decided; if not, it was answered, or waits."""
    if event.request.kind in _CONTROL_EVENTS and (barrier := draft.barrier.keep(event)) is not None:
        draft.barrier = barrier
        return False
    if not _may_speak(draft, event):
        return False
    outcome = draft.idempotency.look_up(event.name, event.request)
    return outcome is None or not _repeated(draft, event, outcome)


def _may_speak(draft: StateDraft, event: RequestIn) -> bool:
    name, request_id, run = event.name, event.request.id, draft.env.settings.run
    if not name:
        answers.refuse_peer(draft, event, "a client without a name: set the socket's identity to the component's name")
        return False
    if event.user is not None and event.user != component_of(name):
        answers.refuse_peer(draft, event, f"the key is that of {event.user}, not of {name}")
        return False
    if run and run_of(name, request_id) not in ("", run):
        answers.refuse_peer(draft, event, _ANOTHER_RUN, OTHER_RUN_RESPONSE)
        return False
    draft.sessions, hearing = draft.sessions.hear(event.connection, name, request_id, draft.now_s)
    pending = draft.pending
    if hearing is Hearing.UNCLEAR and name not in pending.unclear and event.connection not in pending.refused:
        draft.pending = pending.with_unclear(event, draft.now_s)
    elif hearing in (Hearing.TAKEN, Hearing.UNCLEAR):
        refuse_second(draft, event)
    return hearing is Hearing.ACCEPTED


def refuse_second(draft: StateDraft, event: RequestIn) -> None:
    """Refuse a second process under one name."""
    answers.refuse_peer(draft, event, _TWO_OF_A_NAME.format(name=event.name))


def _repeated(draft: StateDraft, event: RequestIn, outcome: RequestStatus | Response) -> bool:
    """Answer a request that comes again with its id, without doing it again. False: it may be done."""
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
    # A translator that knows ids answers what became of it. Setting something twice does no harm either; an
    # action does, so what nobody knows stays unknown.
    may_send = draft.idempotency.ids_known or request.kind != _ACTION
    if may_send and (draft.control.holder == name or reads(request)):
        return False
    reason, detail = "outcome unknown: it was sent once, and is not sent again", ResponseDetail.OUTCOME_UNKNOWN
    answers.reply(draft, event, Response(int(ControlResponse.NO_RESPONSE), b"", reason, request.id, detail))
    return True


# --- 2. authorised: the scheduler answers by itself, or who asks may command the microscope -------------------------


def authorise(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether a request is for the translator, and its client may ask for it; if not, it was answered."""
    kind, subject = event.request.kind, event.request.subject
    if kind == RELAY_REQUEST:  # a supervisor's last words come after the end
        publishing.publish_for_process(draft, event)
    elif draft.control.ended:
        control_change.answer_unless_ending(
            draft, event, ControlResponse.FAILURE, HAS_ENDED, ResponseDetail.EXPERIMENT_ENDED
        )
        if kind == ControlRequest.ADD_EXP_PRBLM:  # seen too late to be flagged: the record is to show it
            publishing.publish_entries(draft)
    elif kind == RESTART_REQUEST:
        publishing.order_restart(draft, event)
    elif kind == CLOCK_REQUEST:
        _tell_time(draft, event)
    elif kind == LEASE_REQUEST:
        _renew_lease(draft, event)
    elif kind <= 0:
        why = f"there is no request with the number {kind}"
        answers.answer(draft, event, ControlResponse.CMD_NOT_SUPPORTED, why)
    elif (control_event := _CONTROL_EVENTS.get(kind)) is not None:
        return control_change.decide(draft, ControlInput(control_event, event.name, int(subject or 0)), event)
    else:
        wanted = _microscope_event(event.request, draft.env.settings.rules)
        return control_change.decide(draft, ControlInput(wanted, event.name), event)
    return False


def _microscope_event(request: Request, rules: Rules) -> ArbitrationEvent:
    if reads(request):
        return ArbitrationEvent.READ
    is_adjustable = request.kind == _PARAM and request.subject.name in rules.adjustable
    return ArbitrationEvent.ADJUST if is_adjustable else ArbitrationEvent.COMMAND


def _renew_lease(draft: StateDraft, event: RequestIn) -> None:
    """Begin the lease of the holder anew; that is not written down, as it is done again and again."""
    name, holder = event.name, draft.control.holder
    if name != holder:
        why = f"{name} is not in control, {holder or 'nobody'} is"
        answers.answer(draft, event, ControlResponse.NOT_IN_CONTROL, why)
        return
    draft.lease = draft.lease.asked(event.request.subject, draft.now_s)
    response = Response(int(ControlResponse.SUCCESS), b"", "", event.request.id)
    draft.effects.append(Reply(event.connection, name, response, LEASE_REQUEST))


def _tell_time(draft: StateDraft, event: RequestIn) -> None:
    """Tell what all parts of an experiment have in common: the run, what time it is, and how it passes."""
    settings = draft.env.settings
    common = {"run": settings.run, "simulated": settings.simulated, "now_ns": draft.now_ns, "in_use": _in_use(draft)}
    told = json.dumps({**settings.clock, **common, "versions": dict(settings.versions)}).encode()
    response = Response(int(ControlResponse.SUCCESS), told, "", event.request.id)
    draft.effects.append(Reply(event.connection, event.name, response, CLOCK_REQUEST))


def _in_use(draft: StateDraft) -> str:
    """Return why an experiment without a plan is not to end now; empty: nothing keeps it."""
    if draft.control.mode is ControlMode.MANUAL:
        return "the mode is MANUAL"
    return f"{draft.control.holder} is in control" if draft.control.holder else ""


# --- 3. within limits: nothing forbids it, and the microscope is where it has to be ---------------------------------


def check_limits(draft: StateDraft, event: RequestIn, deadline_s: float = 0.0) -> ForwardedRequest | None:
    """Return a request as it may be sent; None: it was refused, or waits for a value or a move."""
    request, mapped = event.request, None
    if draft.env.frame is not None:
        outgoing = draft.env.frame.outgoing(event.name, request, draft.now_ns)
        if isinstance(outgoing, Response):
            answers.refuse(draft, event, outgoing)
            return None
        mapped = outgoing
    states_seen, command = draft.microscope.states_seen, not reads(request)
    job = ForwardedRequest.of(event, command=command, deadline_s=deadline_s, states_seen=states_seen, mapped=mapped)
    if not job.command:
        return job
    if (why := _tip_comes_first(draft)) is not None:
        answers.answer(draft, event, ControlResponse.NOT_FREE, why)
        return None
    if not deadline_s and _reads_first(draft, event):
        return None
    if draft.forwarder.up and not _is_within_limits(draft, event, mapped):
        return None  # if not, there is nobody to tell what is in force, as the asker will hear
    _use_lease(draft, event.name)
    if request.kind == _ACTION and not _may_act_here(draft, event):
        return None
    return job


def _use_lease(draft: StateDraft, client: str) -> None:
    """Begin the lease anew; what a person adjusts beside the holder is no sign of life of the holder."""
    if client == draft.control.holder:
        draft.lease = draft.lease.commanded(draft.now_ns, draft.now_s)


def _tip_comes_first(draft: StateDraft) -> str | None:
    """Return why nobody commands, since the tip was left in danger; None: whoever is in control may."""
    dog, sees_to_tip = draft.watchdog, draft.control.sees_to_tip
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


def _is_within_limits(draft: StateDraft, event: RequestIn, mapped: MappedRequest | None) -> bool:
    if mapped is None:
        refusal = draft.limits.check(event.name, event.request, draft.now_ns)
    else:
        refusal = draft.limits.check(event.name, mapped.request, draft.now_ns, mapped.names)
        if refusal is not None:
            refusal = replace(refusal, reason=f"{refusal.reason}; {mapped.said}")
    if refusal is not None:
        answers.refuse(draft, event, refusal)
    return refusal is None


def _reads_first(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether the microscope has to be asked for the values that the limits depend on; then it is."""
    unread = draft.limits.to_be_read(event.request)
    if not unread or not draft.forwarder.up:
        return False
    others = [(one.event.name, one.event.request) for one in draft.pending.reads]
    for who, request in others + draft.forwarder.requests():
        if both := set(unread) & set(draft.limits.to_be_read(request)):
            reason = f"{min(both)} is being changed by {who}"
            answers.refuse(draft, event, Response(int(ControlResponse.PARAM_ERROR), b"", reason))
            return True
    _use_lease(draft, event.name)
    draft.idempotency = draft.idempotency.noted(event.name, event.request, RequestStatus.PENDING)
    number = draft.forwarder.number
    read = PendingRead(number, event, frozenset(unread), draft.now_s + draft.forwarder.timeout_s)
    draft.pending = draft.pending.without_read(number, read)
    for name in unread:
        _read(draft, name, partial(_was_read, number, name))
    return True


def _was_read(number: int, name: str, draft: StateDraft, response: Response) -> None:
    _forget_unread(name, draft, response)
    if (read := draft.pending.read(number)) is None:
        return  # it was called back
    rest = replace(read, names=read.names - {name})
    if response.code == ControlResponse.NO_RESPONSE:
        draft.pending = draft.pending.without_read(number)
        answers.answer_unsent(draft, read.event, response)
    elif rest.names:
        draft.pending = draft.pending.without_read(number, rest)
    else:
        draft.pending = draft.pending.without_read(number)
        pass_on(draft, read.event, read.deadline_s)


def read_ahead(draft: StateDraft) -> None:
    """Ask for the values of which it counts for how long they hold."""
    for name in draft.limits.to_be_known():
        _read(draft, name, partial(_forget_unread, name))


def _read(draft: StateDraft, name: str, on_answer: OwnAnswer) -> None:
    parameter = Parameter(name)
    request = Request(_PARAM, parameter, draft.env.codec.encode(parameter))
    draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s, on_answer)


def _forget_unread(name: str, draft: StateDraft, response: Response) -> None:
    if not response.ok:
        draft.limits = draft.limits.forget(name)


def _may_act_here(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether an action may be sent at once: if not, it is answered, or waits for a move."""
    if draft.env.frame is not None:
        move = draft.env.frame.move_before(str(event.request.subject), draft.now_ns)
        if move is not None and _moves_first(draft, event, move):
            return False
    return _is_in_place(draft, event)


def _is_in_place(draft: StateDraft, event: RequestIn) -> bool:
    refusal = draft.limits.check_place(event.request)
    if refusal is not None:
        answers.refuse(draft, event, refusal)
    return refusal is None


def _moves_first(draft: StateDraft, event: RequestIn, move: MappedRequest) -> bool:
    """Move the microscope before an action. Returns whether the action waits for that, or was answered."""
    if draft.idempotency.was_sent(event.name, event.request):
        return False
    if draft.pending.move is not None:
        answers.answer(draft, event, ControlResponse.NOT_FREE, "the microscope is being moved for another action")
        return True
    if not _is_within_limits(draft, event, move):
        return True
    on_answer = partial(_moved, draft.forwarder.number + 1)
    draft.forwarder, job = draft.forwarder.ask_own(move.request, draft.now_s, on_answer, move)
    if job is None:
        return False  # nobody is there to be moved, as the action will be told
    draft.pending = replace(draft.pending, move=PrePositioner(event, job, draft.microscope.states_seen))
    draft.idempotency = draft.idempotency.noted(event.name, event.request, RequestStatus.PENDING)
    draft.save()  # with where it is sent: what is told of it is then known after a restart
    return True


def _moved(number: int, draft: StateDraft, response: Response) -> None:
    move = draft.pending.move
    if move is None or move.move.number != number:
        return  # the action was called back
    if response.ok:
        draft.pending = replace(draft.pending, move=move.moved(draft.now_s))
        act_when_moved(draft)
    else:
        draft.pending = replace(draft.pending, move=None)
        answers.answer_unsent(draft, move.event, response)


def act_when_moved(draft: StateDraft) -> None:
    """Send the action that waited for the microscope to be moved, if it is."""
    move = draft.pending.move
    if move is None or not move.is_ready(draft.microscope, draft.now_s):
        return
    draft.pending = replace(draft.pending, move=None)
    if _is_in_place(draft, move.event):  # if not, it was moved by somebody else meanwhile
        states_seen, deadline_s = draft.microscope.states_seen, move.move.deadline_s
        forward(draft, ForwardedRequest.of(move.event, deadline_s=deadline_s, states_seen=states_seen))


# --- 4. forwarded: it is with the translator, or waits for its turn -------------------------------------------------


def forward(draft: StateDraft, job: ForwardedRequest) -> None:
    """Send a request to the translator, once it is remembered."""
    name, request = job.client, job.request
    sent_ns = draft.event_log.sent_ns(name, request, draft.now_ns)
    draft.forwarder, refused = draft.forwarder.ask(job._replace(sent_ns=sent_ns), draft.now_s)
    if refused is not None:
        draft.idempotency = draft.idempotency.forgotten(name, request)
        event = RequestIn(job.connection, name, request, heard_s=job.heard_s)
        answers.reply(draft, event, refused.response)
        return
    draft.event_log = draft.event_log.sending(name, request, sent_ns)
    if job.command:
        draft.limits = draft.limits.sending(name, job.outgoing, draft.now_ns, _names_meant(job))
    if not request.id:
        return
    draft.idempotency = draft.idempotency.noted(name, request, RequestStatus.PENDING)
    if request.kind == _ACTION and (draft.env.frame is not None or not draft.idempotency.ids_known):
        draft.idempotency = draft.idempotency.sent(name, request)
    elif job.mapped is not None:
        draft.save()  # with what it was mapped to: asked again, it is sent the same


# --- 5. settled: the translator has answered, or did not in time ----------------------------------------------------


def settle(draft: StateDraft, settled: SettledRequest) -> None:
    """Take the end of a request: tell, and remember, its outcome."""
    job, end, response = settled.job, settled.end, settled.response
    if end in (ForwardOutcome.ANSWERED, ForwardOutcome.LATE):
        if job.request.id:
            ids_known = response.id == job.request.id
            if ids_known is not draft.idempotency.ids_known:
                draft.idempotency = replace(draft.idempotency, ids_known=ids_known)
        response = answers.with_id(response, job.request)
        if response.ok and (job.command or job.request.kind == _PARAM):
            response = _learn(draft, job, response)
    if not job.client:
        _settle_own(draft, job, end, response)
    elif end is ForwardOutcome.NOT_SENT or (end is ForwardOutcome.ANSWERED and _was_not_sent(response)):
        draft.idempotency = draft.idempotency.not_sent(job.client, job.request)
        answers.take_back(draft, job)
        answers.answer_job(draft, job, response)
    elif end is ForwardOutcome.LATE:
        _settle_late(draft, job, response)
    else:
        if end is ForwardOutcome.UNKNOWN and job.request.kind == _ACTION:
            _action_started(draft, job, is_certain=False)
        _see_feedback(draft, job, response)
        answers.finish(draft, job, response, _unknown_status(response))


def _settle_own(draft: StateDraft, job: ForwardedRequest, end: ForwardOutcome, response: Response) -> None:
    if not reads(job.request):
        answers.write_down(draft, SCHEDULER, job.request, response, job.heard_s)
    if job.on_answer is None:
        safety_commands.settle(draft, job, end, response)
    elif end is not ForwardOutcome.LATE:  # who asked was told before that there was no answer
        job.on_answer(draft, response)


def _settle_late(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    """Take an answer after its client was told that none had come: asked again, it gets that answer."""
    _see_feedback(draft, job, response)
    status = _unknown_status(response)
    draft.idempotency = draft.idempotency.noted(job.client, job.request, status or response)
    if status is None and not response.ok:
        answers.take_back(draft, job)
    answers.write_down(draft, job.client, job.request, response, job.heard_s, sent_ns=job.sent_ns, late=True)
    draft.log("WARNING", f"the translator answered {job.client} late; the answer is kept for its retry")


def _see_feedback(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    feedback = feedback_of(job.request)
    if feedback is None or feedback.on is not False or response.ok:
        return
    if response.code == ControlResponse.NO_RESPONSE:
        draft.microscope = draft.microscope.feedback_may_be_off()
    else:
        draft.microscope = draft.microscope.feedback_was_left()


def _learn(draft: StateDraft, job: ForwardedRequest, response: Response) -> Response:
    """Take what a success changed, or told. Returns the answer, in the coordinates of its client."""
    request, frame, now_ns = job.request, draft.env.frame, draft.now_ns
    told = None
    if request.kind == _PARAM and response.payload:
        told = draft.env.codec.decode_parameter(response.payload)
    draft.limits = draft.limits.carried_out(job.outgoing, now_ns, told, _names_meant(job), job.client)
    if frame is not None:
        frame.carried_out(job.outgoing, told, now_ns)
        if request.kind == _PARAM and (mapped := frame.answer(request, told, now_ns)) is not None:
            response = replace(response, payload=draft.env.codec.encode(mapped))
    if request.kind == _ACTION:
        _action_started(draft, job, is_certain=True)
    elif (feedback := feedback_of(request)) is not None:
        draft.microscope = draft.microscope.with_feedback(feedback)
    if job.command:
        _use_lease(draft, job.client)
        if draft.control.mode is ControlMode.MANUAL:
            draft.by_hand = draft.by_hand.requested(request)
    return response


def _action_started(draft: StateDraft, job: ForwardedRequest, *, is_certain: bool) -> None:
    action = str(job.request.subject)
    draft.watchdog = draft.watchdog.started(action, job.states_seen, draft.microscope)
    is_away = is_certain and action == draft.watchdog.settings.retract
    draft.microscope = draft.microscope.after_action(action, is_away=is_away)


def _names_meant(job: ForwardedRequest) -> tuple[str, ...] | None:
    """Return the parameters that the asker means to set; None: all that are sent."""
    return None if job.mapped is None else tuple(job.mapped.names)


def _was_not_sent(response: Response) -> bool:
    return response.code == ControlResponse.NO_RESPONSE and response.detail is ResponseDetail.NOT_SENT


def _unknown_status(response: Response) -> RequestStatus | None:
    """Return UNKNOWN where the controller did not answer its translator: that one can say more when asked again."""
    return RequestStatus.UNKNOWN if response.code == ControlResponse.NO_RESPONSE else None


def reads(request: Request) -> bool:
    """Return whether a request disturbs nothing."""
    return request.kind == ControlRequest.ACTION_SUPPORT or (request.kind == _PARAM and is_get(request))
