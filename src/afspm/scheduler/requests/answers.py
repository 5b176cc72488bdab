"""The answers to requests: sent to the client, remembered under the request's id, and written to the event log."""

from __future__ import annotations

from collections.abc import Mapping

from afspm.basics.frozen import replace
from afspm.model import ControlResponse, Parameter, Request, Response, ResponseDetail, names
from afspm.model.idempotency_cache import RequestStatus
from afspm.scheduler.control.arbitration import Cause
from afspm.scheduler.events import Reply, RequestIn
from afspm.scheduler.publishing.event_log import AnsweredRequest
from afspm.scheduler.requests.forwarder import ForwardedRequest
from afspm.scheduler.requests.pending_requests import refused_again
from afspm.scheduler.state import StateDraft


def answer(
    draft: StateDraft,
    event: RequestIn,
    code: ControlResponse,
    reason: str = "",
    payload: bytes = b"",
    detail: ResponseDetail = ResponseDetail.NONE,
) -> None:
    """Send the scheduler's own answer to a request, and remember it under the request's id."""
    response = Response(int(code), payload, reason, event.request.id, detail)
    draft.idempotency = draft.idempotency.noted(event.name, event.request, response)
    reply(draft, event, response)


def reply(draft: StateDraft, event: RequestIn, response: Response) -> None:
    """Send an answer without remembering it: a repeated request is decided again."""
    draft.effects.append(Reply(event.connection, event.name, response, event.request.kind))
    write_down(draft, event.name, event.request, response, event.heard_s)


def refuse_peer(draft: StateDraft, event: RequestIn, why: str, code: int = ControlResponse.FAILURE) -> None:
    """Refuse a request of a peer that may not use its name; log the refusal once for each connection."""
    draft.pending, was_refused = refused_again(draft.pending, event.connection)
    if not was_refused:
        draft.log("WARNING", f"refused a request of {event.name or 'a nameless peer'}: {why}")
    reply(draft, event, Response(int(code), b"", why, event.request.id))


def answer_unsent(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    """Answer a request that is not sent.

    The outcome of a repeated request stays unknown: it may have been carried out before. An answer NO_RESPONSE is not
    remembered, so that the client may repeat the request.
    """
    unknown = ResponseDetail.OUTCOME_UNKNOWN
    if job.is_repeated:
        reason = f"outcome unknown: it was sent once, and is not sent again ({response.reason})"
        response = Response(int(ControlResponse.NO_RESPONSE), b"", reason, job.request.id, unknown)
        finish(draft, job, response, RequestStatus.UNKNOWN)
    elif response.code == ControlResponse.NO_RESPONSE:
        draft.idempotency = draft.idempotency.forgotten(job.client, job.request)
        answer_job(draft, job, Response(response.code, b"", response.reason, job.request.id, ResponseDetail.NOT_SENT))
    else:
        finish(draft, job, replace(response, payload=b"", id=job.request.id))


def log_refusal(draft: StateDraft, client: str, refusal: Response) -> None:
    """Log the refusal of a request by a limit, and let a holder wait as long as the limit demands."""
    # a refusal that time lifts is the normal course of a plan
    draft.log("WARNING" if refusal.again_ns is None else "INFO", f"refused {client}: {refusal.reason}")
    if refusal.again_ns is not None and client == draft.control.holder:
        draft.lease = draft.lease.waiting(refusal.again_ns)


def with_alias(draft: StateDraft, request: Request, refusal: Response) -> Response:
    """Return a refusal that also has the client's own name of the bias."""
    if not (alias := request.alias):
        return refusal
    sign = "-" if draft.env.settings.limits.bias.sign < 0 else ""
    return replace(refusal, reason=f"{refusal.reason}; here {alias} is {sign}{names.TIP_BIAS_VOLTAGE}")


def refusal_for_second_electrode(request: Request, values: Mapping[str, Parameter | None]) -> Response | None:
    """Refuse a bias of the sample that is not the whole voltage; None: it is.

    Args:
        values: the values in force by name; a microscope without a second electrode has none.
    """
    if not request.alias or names.SAMPLE_BIAS not in values:
        return None
    volts = "no value" if (found := values[names.SAMPLE_BIAS]) is None else f"{found.value} {found.unit or 'V'}"
    try:
        if found is not None and float(found.value or "nan") == 0.0:
            return None
    except ValueError:
        pass
    why = (
        f"{request.alias} is the whole voltage only while the second electrode is at 0 V, and "
        f"{names.SAMPLE_BIAS} reads {volts}: set it to 0 V, or set {names.TIP_BIAS_VOLTAGE}"
    )
    return Response(int(ControlResponse.PARAM_ERROR), b"", why, request.id)


def take_off(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    """Answer a waiting request that is not sent, and end its turn."""
    draft.forwarder = draft.forwarder.without(job.number)
    if job.command:
        draft.pending = replace(draft.pending, turn=None)
    answer_unsent(draft, job, response)


def finish(draft: StateDraft, job: ForwardedRequest, response: Response, status: RequestStatus | None = None) -> None:
    """Remember the answer to a request, or that its outcome is unknown, and send it."""
    draft.idempotency = draft.idempotency.noted(job.client, job.request, response if status is None else status)
    if job.sent_s is not None and status is None and not response.ok:
        take_back(draft, job)  # a refused request does not count as a use; one of unknown outcome does
    answer_job(draft, job, response)


def take_back(draft: StateDraft, job: ForwardedRequest) -> None:
    """Undo the uses that a request counted against its limits and its approval."""
    draft.grants = draft.grants.not_done(job.client, job.request)
    mapped = job.mapped
    draft.limits = draft.limits.not_done(job.client, job.outgoing, None if mapped is None else mapped.names)


def answer_job(draft: StateDraft, job: ForwardedRequest, response: Response) -> None:
    """Answer over the client's newest connection; without a request id only over the connection of the request."""
    write_down(draft, job.client, job.request, response, job.heard_s, sent_ns=job.sent_ns)
    connection = draft.peers.sessions.connection_of(job.client)
    # without an id a restarted client would take it for the answer to its own request
    if connection is not None and (job.request.id or connection == job.connection):
        draft.effects.append(Reply(connection, job.client, response, job.request.kind))


def call_back(draft: StateDraft, former: str | None, cause: Cause | None) -> None:
    """Remove unsent commands from the queue, and refuse them with NOT_IN_CONTROL.

    Args:
        former: the former holder, whose commands are removed; None: the commands of all clients.
        cause: the reason in the answer; None: the mode was changed.
    """
    reason = f"control was taken before this was sent: {cause.text if cause else 'the mode was changed'}"
    draft.forwarder, jobs = draft.forwarder.called_back(lambda job: job.command and former in (None, job.client))
    for job in jobs:
        answer_unsent(draft, job, Response(int(ControlResponse.NOT_IN_CONTROL), b"", reason, job.request.id))


def write_down(
    draft: StateDraft,
    who: str,
    request: Request,
    response: Response,
    heard_s: float,
    *,
    sent_ns: int | None = None,
    late: bool = False,
) -> None:
    """Add an answer to the event log."""
    answered = AnsweredRequest(draft.now_ns, who, request, response, draft.now_s - heard_s, late, sent_ns)
    draft.event_log = draft.event_log.add_request(draft.now_s, answered)


def with_id(response: Response, request: Request) -> Response:
    return response if response.id == request.id else replace(response, id=request.id)
