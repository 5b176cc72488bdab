"""Requests for parameters of other instruments, their reports, and the problems of conditions.

A request to set a parameter waits for the next report of its instrument. When the report arrives, the request is
authorised again and checked against its limits and approvals. The answer to the report carries it as an order. An order
is repeated in each answer until a report contains its outcome; the instrument carries out an id once. A limited rate is
not checked here: the order carries the rate, and the instrument keeps to the rate on its way to the target.
"""

from __future__ import annotations

from collections.abc import Callable

from afspm.model import (
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    InstrumentOrder,
    InstrumentReading,
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
from afspm.model.instruments import PARTS, InstrumentOrders, instrument_of
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
from afspm.scheduler.safety.present_state import present_state
from afspm.scheduler.state import SchedulerState, StateDraft
from afspm.wire.messages import INSTRUMENT_READINGS

MaySend = Callable[[StateDraft, ForwardedRequest], Response | None]
"""A function that returns the refusal of a request whose client may no longer send it, else None."""


def is_for_instrument(draft: StateDraft, event: RequestIn) -> bool:
    """Return whether a request is about a parameter of an instrument."""
    subject = event.request.subject
    return isinstance(subject, Parameter) and draft.instruments.owns(subject.name)


def ask(draft: StateDraft, event: RequestIn, job: ForwardedRequest) -> None:
    """Answer a read request from the last report, or queue a set request for the next report."""
    if is_get(event.request):
        _answer_get(draft, event)
        return
    job = job._replace(deadline_s=draft.now_s + draft.env.settings.control.request_timeout_s)
    draft.idempotency = draft.idempotency.noted(event.name, event.request, RequestStatus.PENDING)
    draft.instruments = draft.instruments.asked(job)
    _has_read(draft, instrument_of(event.request.subject.name))


def _answer_get(draft: StateDraft, event: RequestIn) -> None:
    name = event.request.subject.name
    base, _, part = name.rpartition(".")
    if part not in PARTS:
        base, part = name, ""
    reading = draft.instruments.reading(base, draft.now_s)
    value = _part(reading, part)
    if value is None:
        why = f"{name} is not known: {reading.reason or 'it has none'}"
        answers.answer(draft, event, ControlResponse.PARAM_ERROR, why)
        return
    found = Parameter(name, value, None if part == "busy" else reading.unit or None)
    answers.answer(draft, event, ControlResponse.SUCCESS, payload=draft.env.codec.encode(found))


def _part(reading: InstrumentReading, part: str) -> str | None:
    if reading.value is None:
        return None
    if part == "busy":
        return "true" if reading.busy else "false"
    number = reading.target if part == "target" else reading.value
    return None if number is None else repr(number)


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
            draft.limits = draft.limits.in_force(target, draft.now_ns, was_read=True)
    _publish(draft, report)
    order = _next_order(draft, name, may_send)
    draft.instruments = draft.instruments.answered(name, draft.now_s)
    orders = InstrumentOrders(draft.instruments.token(name), () if order is None else (order,))
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
    if first is None or first.order is not None:
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


def take_read_value(draft: StateDraft, purpose: ReadForOrder, response: Response) -> None:
    """Store a value of the microscope, or that it could not be read, for an order that waits for it."""
    answered = draft.env.codec.decode_parameter(response.payload) if response.ok and response.payload else None
    answered = answered if answered is not None and answered.name == purpose.name else None
    draft.instruments = draft.instruments.was_read(purpose.number, purpose.name, answered)


def _limit_refusal(draft: StateDraft, waiting: OpenOrder) -> Response | None:
    job, request = waiting.job, waiting.job.request
    base, _, part = request.subject.name.rpartition(".")
    if part in PARTS and draft.instruments.owns(base):
        why = f"{request.subject.name} can only be read: set {base}"
        return Response(int(ControlResponse.PARAM_NOT_SUPPORTED), b"", why, request.id)
    reading = draft.instruments.reading(request.subject.name, draft.now_s)
    if reading.value is None:
        why = f"{request.subject.name} can't be set while its value is not known: {reading.reason}"
        return Response(int(ControlResponse.PARAM_ERROR), b"", why, request.id)
    refusal = draft.limits.check(job.client, request, draft.now_ns, is_repeated=job.is_repeated)
    read = waiting.read if draft.forwarder.up else {}
    return refusal or draft.limits.check_forbidden(request, present_state(draft, read))


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
    draft.limits = draft.limits.sending(job.client, job.request, draft.now_ns)
    approvals.sending(draft, job)
    if job.request.id and draft.limits.counts(job.request):
        draft.idempotency = draft.idempotency.sent(job.client, job.request)
    draft.instruments = draft.instruments.handed_out(instrument, OpenOrder(sent, order))
    return order


def _settle(draft: StateDraft, instrument: str, found: OpenOrder, outcome: OrderOutcome) -> None:
    job, wanted = found.job, found.job.request.subject
    draft.instruments = draft.instruments.settled(instrument, job.number)
    payload = b""
    if outcome.response == ControlResponse.SUCCESS:
        draft.limits = draft.limits.carried_out(job.request, draft.now_ns, who=job.client)
        approvals.done(draft, job)
        if job.client == draft.control.holder:
            draft.lease = draft.lease.commanded(draft.now_ns, draft.now_s)
        target = draft.instruments.reading(wanted.name, draft.now_s)
        # its target in force: controllers round
        in_force = wanted if target.target is None else Parameter(wanted.name, repr(target.target), target.unit or None)
        payload = draft.env.codec.encode(in_force)
    answers.finish(draft, job, Response(outcome.response, payload, outcome.reason, job.request.id))


# --- time -----------------------------------------------------------------------------------------------------------


def expire(draft: StateDraft) -> None:
    """Answer the instrument requests whose deadline has passed, and evaluate the conditions."""
    timeout_s = draft.env.settings.control.request_timeout_s
    for name, one in draft.instruments.overdue(draft.now_s):
        draft.instruments = draft.instruments.settled(name, one.job.number)
        request_id = one.job.request.id
        if one.order is None:
            why, detail = f"not sent: {name} has not reported for {timeout_s:g} s", ResponseDetail.NOT_SENT
            response = Response(int(ControlResponse.NO_RESPONSE), b"", why, request_id, detail)
            answers.answer_unsent(draft, one.job, response)
            continue
        why = f"outcome unknown: {name} did not answer within {timeout_s:g} s"
        response = Response(int(ControlResponse.NO_RESPONSE), b"", why, request_id, ResponseDetail.OUTCOME_UNKNOWN)
        draft.limits = draft.limits.unknown(one.job.request)
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
