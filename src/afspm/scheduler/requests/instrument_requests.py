"""Requests for parameters of other instruments, their reports, and the problems of conditions.

A request to set a parameter waits for the next report of its instrument. When the report arrives, the request is
authorised again and checked against its limits and approvals. The answer to the report carries it as an order. An order
is repeated in each answer until a report contains its outcome; the instrument carries out an id once. A limited rate is
not checked here: the order carries the rate, and the instrument keeps to the rate on its way to the target.

A request to read is answered from the last report, unless a request of the run may have changed something since then:
then an order to measure goes to the instrument. So does a request for the part "now". An instrument with `patience_s`
gets the answer to its report once there is an order, so that an order does not wait for the next report.
"""

from __future__ import annotations

from collections.abc import Callable

from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    InstrumentOrder,
    InstrumentReadings,
    OrderOutcome,
    Parameter,
    RelayedMessage,
    Request,
    Response,
    ResponseDetail,
    component_of,
)
from afspm.model.idempotency_cache import RequestStatus
from afspm.model.instruments import NOW, InstrumentOrders, instrument_of, split
from afspm.model.problems import CONDITIONS
from afspm.scheduler.control import control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, ControlInput
from afspm.scheduler.events import RequestIn
from afspm.scheduler.instruments.conditions import OLDEST_S
from afspm.scheduler.instruments.known_instruments import OpenOrder
from afspm.scheduler.publishing import own_packets as publishing
from afspm.scheduler.requests import answers, approvals
from afspm.scheduler.requests.forwarder import ForwardedRequest, ReadForOrder
from afspm.scheduler.safety.forbidden_states import judging, to_read
from afspm.scheduler.safety.limit_checker import is_get
from afspm.scheduler.safety.movers import MoverState
from afspm.scheduler.safety.present_state import present_state
from afspm.scheduler.state import SchedulerState, StateDraft
from afspm.wire.messages import INSTRUMENT_READINGS

_LONGEST_HOLD_S = 1.0  # of a report without an order, which is answered then
MaySend = Callable[[StateDraft, ForwardedRequest], Response | None]
"""A function that returns the refusal of a request whose client may no longer send it, else None."""


def is_for_instrument(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether a request is about a parameter of an instrument."""
    subject = event.request.subject
    return isinstance(subject, Parameter) and draft.instruments.owns(subject.name)


def ask(draft: StateDraft, event: RequestIn, job: ForwardedRequest, may_send: MaySend) -> None:
    """Answer a request from the last report, or queue it for the next report."""
    if is_get(event.request) and not _is_to_be_measured(draft, event):
        code, why, payload = _value(draft, event.request)
        answers.answer(draft, event, code, why, payload)
        return
    job = job._replace(deadline_s=draft.now_s + draft.env.settings.control.request_timeout_s)
    draft.idempotency = draft.idempotency.noted(event.name, event.request, RequestStatus.PENDING)
    draft.instruments = draft.instruments.asked(job)
    _offer(draft, instrument_of(event.request.subject.name), may_send)


def _offer(draft: StateDraft, instrument: str, may_send: MaySend) -> None:
    # an order that can be given now is not kept for the next report
    if not _has_read(draft, instrument) or (held := draft.instruments.held_report(instrument)) is None:
        return
    if (order := _next_order(draft, instrument, may_send)) is not None:
        _answer_report(draft, held, instrument, order)


def _is_to_be_measured(draft: StateDraft, event: RequestIn) -> bool:
    name, part = split(event.request.subject.name)
    if draft.instruments.reading(name, draft.now_s).value is None:
        return False  # refused with the reason, at once
    return part == NOW or (not part and draft.instruments.is_from_before_a_change(name, draft.now_s))


def _value(draft: StateDraft, request: Request) -> tuple[ControlResponse, str, bytes]:
    name, part = split(request.subject.name)
    reading = draft.instruments.reading(name, draft.now_s)
    number = reading.target if part == "target" else reading.value
    if reading.value is None or number is None:
        why = f"{request.subject.name} is not known: {reading.reason or 'it has none'}"
        return ControlResponse.PARAM_ERROR, why, b""
    if part == "busy":
        found = Parameter(request.subject.name, "true" if reading.busy else "false")
    elif part == "age":
        found = Parameter(request.subject.name, repr(draft.instruments.age_s(name, draft.now_s)), "s")
    else:
        found = Parameter(request.subject.name, repr(number), reading.unit or None)
    return ControlResponse.SUCCESS, "", draft.env.codec.encode(found)


# --- reports --------------------------------------------------------------------------------------------------------


def report_in(draft: StateDraft, event: RequestIn) -> InstrumentReadings | None:
    """Return the instrument report in a request; None unless the report is about the sender's own parameters."""
    subject = event.request.subject
    if event.request.kind != RELAY_REQUEST or not isinstance(subject, RelayedMessage):
        return None
    if subject.message != INSTRUMENT_READINGS.name:
        return None
    report = draft.env.codec.decode_packet(subject.message, subject.payload)
    if not isinstance(report, InstrumentReadings):
        return None
    owner = component_of(event.name)
    is_own = report.instrument == owner and owner in draft.instruments.settings.instruments
    return report if is_own and all(instrument_of(one.name) == owner for one in report.readings) else None


def take_report(draft: StateDraft, event: RequestIn, report: InstrumentReadings, may_send: MaySend) -> None:
    """Store a report, settle the orders with an outcome in it, and answer with the next order."""
    name = report.instrument
    draft.instruments = draft.instruments.reported(report, draft.now_s, draft.now_ns)
    for outcome in report.outcomes:
        draft.instruments = draft.instruments.reported_outcome(outcome)
        if (found := draft.instruments.found(name, outcome)) is not None:
            _settle(draft, name, found, outcome)
    for reading in report.readings:
        if reading.target is not None and reading.name in draft.limits.limits.bounded:
            target = Parameter(reading.name, repr(reading.target), reading.unit or None)
            if draft.instruments.first(name) is None and draft.limits.seems_moved(reading.name, reading.target):
                draft.log("WARNING", f"{reading.name} has another target, which the run has not set: approach again")
                draft.limits = draft.limits.with_movers(MoverState.moved_by_others)
            draft.limits = draft.limits.in_force(target, draft.now_ns, was_read=True)
    _publish(draft, report)
    order = _next_order(draft, name, may_send)
    if order is None and report.patience_s > 0.0:
        until_s = draft.now_s + min(report.patience_s, _LONGEST_HOLD_S)
        draft.instruments = draft.instruments.held(name, event, until_s)
        return
    _answer_report(draft, event, name, order)


def _answer_report(draft: StateDraft, event: RequestIn, instrument: str, order: InstrumentOrder | None) -> None:
    draft.instruments = draft.instruments.answered(instrument, draft.now_s)
    orders = InstrumentOrders(draft.instruments.token(instrument), () if order is None else (order,))
    answers.answer(draft, event, ControlResponse.SUCCESS, payload=draft.env.codec.encode(orders))


def _publish(draft: StateDraft, report: InstrumentReadings) -> None:
    after = draft.instruments.to_publish(report, draft.now_s)
    if after is None:
        return
    draft.instruments = after
    readings = InstrumentReadings(draft.now_ns, report.instrument, after.published(report.instrument))
    envelope = f"{INSTRUMENT_READINGS.name}_{report.instrument}"
    publishing.publish(draft, envelope, draft.env.codec.encode(readings))


def _next_order(draft: StateDraft, instrument: str, may_send: MaySend) -> InstrumentOrder | None:
    while (first := draft.instruments.first(instrument)) is not None:
        if first.order is not None:
            return first.order
        if not first.job.command:
            return _hand_out_reading(draft, instrument, first)
        if not _has_read(draft, instrument):
            return None
        refusal = may_send(draft, first.job) or _limit_refusal(draft, first) or approvals.refusal(draft, first.job)
        if refusal is None:
            return _hand_out(draft, instrument, first)
        answers.log_refusal(draft, first.job.client, refusal)
        draft.instruments = draft.instruments.settled(instrument, first.job.number)
        answers.answer_unsent(draft, first.job, refusal)
    return None


def _has_read(draft: StateDraft, instrument: str) -> bool:
    # Whether the values of the microscope that forbidden states need are there for the first order. They are read in
    # the line of the commands; a command that may change them makes them void (`present_state.sending`).
    first = draft.instruments.first(instrument)
    if first is None or first.order is not None or not first.job.command:
        return True
    needed = to_read(judging(draft.limits.limits, first.job.request))
    if not needed or not draft.forwarder.up:
        return True
    if first.read_s is not None and draft.now_s - first.read_s <= OLDEST_S:
        return first.read.keys() >= set(needed)
    draft.instruments = draft.instruments.asked_to_read(instrument, draft.now_s)
    for name in needed:
        request = Request(int(ControlRequest.PARAM), Parameter(name))
        draft.forwarder, _ = draft.forwarder.ask_own(request, draft.now_s, ReadForOrder(first.job.number, name))
    return False


def take_read_value(draft: StateDraft, purpose: ReadForOrder, response: Response, may_send: MaySend) -> None:
    """Store a value of the microscope, or that it could not be read, for an order that waits for it."""
    answered = draft.env.codec.decode_parameter(response.payload) if response.ok and response.payload else None
    answered = answered if answered is not None and answered.name == purpose.name else None
    draft.instruments = draft.instruments.was_read(purpose.number, purpose.name, answered)
    for name in draft.instruments.settings.instruments:
        _offer(draft, name, may_send)


def _limit_refusal(draft: StateDraft, waiting: OpenOrder) -> Response | None:
    job, request = waiting.job, waiting.job.request
    base, part = split(request.subject.name)
    if part:
        why = f"{request.subject.name} can only be read: set {base}"
        return Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", why, request.id)
    reading = draft.instruments.reading(request.subject.name, draft.now_s)
    if reading.value is None:
        why = f"{request.subject.name} can't be set while its value is not known: {reading.reason}"
        return Response(int(ControlResponse.PARAM_ERROR), b"", why, request.id)
    if draft.microscope.is_free:
        draft.limits = draft.limits.with_movers(MoverState.free)
    refusal = draft.limits.check(job.client, request, draft.now_ns, is_repeated=job.is_repeated)
    read = waiting.read if draft.forwarder.up else {}
    return refusal or draft.limits.check_forbidden(request, present_state(draft, read))


def _hand_out_reading(draft: StateDraft, instrument: str, waiting: OpenOrder) -> InstrumentOrder:
    job, (name, _) = waiting.job, split(waiting.job.request.subject.name)
    order = InstrumentOrder(job.number, job.request.id or str(job.number), Parameter(name))
    draft.instruments = draft.instruments.handed_out(instrument, OpenOrder(job, order))
    return order


def _hand_out(draft: StateDraft, instrument: str, waiting: OpenOrder) -> InstrumentOrder:
    job, wanted = waiting.job, waiting.job.request.subject
    limit = draft.env.settings.limits.parameters.get(wanted.name)
    rate_per_s = None if limit is None else limit.rate_per_s
    order = InstrumentOrder(
        job.number,
        job.request.id or str(job.number),
        wanted,
        rate_per_s,
        "" if limit is None or rate_per_s is None else limit.unit or "",
    )
    sent = job._replace(sent_s=draft.now_s, sent_ns=draft.now_ns)
    draft.limits = draft.limits.sending(job.client, job.request, draft.now_ns, is_repeated=job.is_repeated)
    approvals.sending(draft, job)
    if job.request.id and draft.limits.counts(job.request):
        draft.idempotency = draft.idempotency.sent(job.client, job.request)
    draft.instruments = draft.instruments.handed_out(instrument, OpenOrder(sent, order))
    return order


def _settle(draft: StateDraft, instrument: str, found: OpenOrder, outcome: OrderOutcome) -> None:
    job, wanted = found.job, found.job.request.subject
    draft.instruments = draft.instruments.settled(instrument, job.number)
    payload = b""
    if not job.command:
        code, why = outcome.response, outcome.reason
        if code == ControlResponse.SUCCESS:
            code, why, payload = _value(draft, job.request)
        answers.finish(draft, job, Response(int(code), payload, why, job.request.id))
        return
    draft.instruments = draft.instruments.changed(draft.now_s)
    if outcome.response == ControlResponse.SUCCESS:
        draft.limits = draft.limits.carried_out(job.request, draft.now_ns, who=job.client)
        approvals.done(draft, job)
        if job.client == draft.control.holder:
            draft.lease = draft.lease.commanded(draft.now_ns, draft.now_s)
        target = draft.instruments.reading(wanted.name, draft.now_s)
        # its target in force: controllers round
        in_force = wanted if target.target is None else Parameter(wanted.name, repr(target.target), target.unit or None)
        payload = draft.env.codec.encode(in_force)
    elif outcome.response == ControlResponse.NO_RESPONSE:
        draft.limits = draft.limits.unknown(job.request)
        response = Response(outcome.response, b"", outcome.reason, job.request.id, ResponseDetail.OUTCOME_UNKNOWN)
        answers.finish(draft, job, response, RequestStatus.UNKNOWN)
        return
    answers.finish(draft, job, Response(outcome.response, payload, outcome.reason, job.request.id))


# --- time -----------------------------------------------------------------------------------------------------------


def expire(draft: StateDraft) -> None:
    """Answer the instrument requests whose deadline has passed, and evaluate the conditions."""
    timeout_s = draft.env.settings.control.request_timeout_s
    for name in draft.instruments.held_too_long(draft.now_s):
        held = draft.instruments.held_report(name)
        assert held is not None
        _answer_report(draft, held, name, None)
    for name, one in draft.instruments.overdue(draft.now_s):
        draft.instruments = draft.instruments.settled(name, one.job.number)
        request_id = one.job.request.id
        if one.order is not None and not one.job.command:
            why = f"{name} has sent no new value of {one.order.parameter.name} within {timeout_s:g} s"
            answers.answer_unsent(draft, one.job, Response(int(ControlResponse.NO_RESPONSE), b"", why, request_id))
            continue
        if one.order is None:
            why, detail = f"not sent: {name} has not reported for {timeout_s:g} s", ResponseDetail.NOT_SENT
            response = Response(int(ControlResponse.NO_RESPONSE), b"", why, request_id, detail)
            answers.answer_unsent(draft, one.job, response)
            continue
        why = f"outcome unknown: {name} did not answer within {timeout_s:g} s"
        response = Response(int(ControlResponse.NO_RESPONSE), b"", why, request_id, ResponseDetail.OUTCOME_UNKNOWN)
        draft.limits = draft.limits.unknown(one.job.request)
        draft.instruments = draft.instruments.changed(draft.now_s)
        answers.finish(draft, one.job, response, RequestStatus.UNKNOWN)
    draft.instruments = draft.instruments.evaluated(draft.now_s, draft.now_ns)


def flag_is_due(state: SchedulerState | StateDraft) -> bool:
    """Return whether the problem of a condition must be flagged or cleared."""
    return _next_flag(state) is not None


def flag(draft: StateDraft) -> bool:
    """Flag or clear the problem of one condition; return False if no problem has to change."""
    if (found := _next_flag(draft)) is None:
        return False
    event, problem, why = found
    if why:
        draft.log("WARNING", f"a condition does not hold: {why}")
    control_change.decide(draft, ControlInput(event, CONDITIONS, problem))
    return True


def _next_flag(state: SchedulerState | StateDraft) -> tuple[ArbitrationEvent, int, str] | None:
    # not before the startup barrier opens: the state of before the restart is published first
    if state.control.ended or state.barrier.until_s is not None or not state.instruments.settings.problems:
        return None
    flagged = state.control.problems
    wanted = state.instruments.problems(flagged)
    for problem, why in wanted.items():
        if problem not in flagged:
            return ArbitrationEvent.FLAG, problem, why
    for problem, author in flagged.items():
        # only the flag raised for a condition: a flag of a component waits for its solver
        if author == CONDITIONS and problem not in wanted:
            return ArbitrationEvent.CLEAR, problem, ""
    return None
