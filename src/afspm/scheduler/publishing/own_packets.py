"""The scheduler's own packets: control, the event log, and what other processes have it publish."""

from __future__ import annotations

from afspm import wire
from afspm.basics.frozen import replace
from afspm.model import HAS_ENDED, ControlResponse, ResponseDetail
from afspm.scheduler.control.arbitration import may
from afspm.scheduler.control.supervisor_registry import SupervisorRegistry, announcement
from afspm.scheduler.events import Publish, RequestIn
from afspm.scheduler.requests import answers
from afspm.scheduler.state import StateDraft
from afspm.wire.messages import CONTROL_STATE, JOURNAL, NOTE


def publish(draft: StateDraft, envelope: str, payload: bytes, time_ns: int | None = None) -> None:
    """Publish a packet of the scheduler's own; its time is saved before."""
    packet, history = draft.env.cache.stamp(envelope, payload, draft.now_ns if time_ns is None else time_ns)
    draft.effects.append(Publish(packet, None, history))
    draft.save()


def publish_control(draft: StateDraft) -> None:
    """Tell all peers who is in control; with that, the startup is over."""
    draft.barrier = draft.barrier.opened(draft.now_s)
    publish(draft, CONTROL_STATE.name, draft.env.codec.encode(draft.control.published()))


def publish_entries(draft: StateDraft) -> None:
    """Publish what has happened since the last time."""
    draft.event_log, entries = draft.event_log.take(draft.env.settings.rules.problems, draft.now_ns)
    if entries.entries:
        publish(draft, JOURNAL.name, draft.env.codec.encode(entries))


def publish_for_process(draft: StateDraft, event: RequestIn) -> None:
    """Publish what a process tells; a supervisor is told in return what it is to do."""
    told = announcement(event, draft.env.codec)
    if not told.envelope:
        answers.answer(draft, event, ControlResponse.FAILURE, told.why)
        return
    if draft.control.ended and told.envelope == NOTE.name:  # its author is told, and writes it into the record
        ended = ResponseDetail.EXPERIMENT_ENDED
        answers.answer(draft, event, ControlResponse.FAILURE, HAS_ENDED, detail=ended)
        return
    if told.states is not None:
        _replace_supervisors(draft, draft.peers.supervisors.told(event.name, told.states, draft.now_s))
    supervisors, orders = draft.peers.supervisors.orders_for(event.name)
    _replace_supervisors(draft, supervisors)
    payload = event.request.subject.payload
    # if it is published already, we were killed before we could answer
    if not draft.env.cache.holds(told.envelope, payload):
        publish(draft, told.envelope, payload)
    answers.answer(draft, event, ControlResponse.SUCCESS, payload=wire.encode_orders(orders))
    draft.end = draft.end.processes_told(draft.peers.supervisors.states_of(event.name), draft.now_s)


def order_restart(draft: StateDraft, event: RequestIn) -> None:
    """Order that a process is started anew."""
    process = str(event.request.subject)
    if may(draft.env.settings.rules.roles.restart, event.name):
        supervisors, why = draft.peers.supervisors.order(process, draft.now_s)
        _replace_supervisors(draft, supervisors)
    else:
        why = f"{event.name} does not have the role restart ([control.roles])"
    if why:
        answers.answer(draft, event, ControlResponse.FAILURE, why)
        return
    draft.save()
    draft.log("INFO", f"{event.name} ordered a restart of {process}")
    answers.answer(draft, event, ControlResponse.SUCCESS)


def _replace_supervisors(draft: StateDraft, supervisors: SupervisorRegistry) -> None:
    draft.peers = replace(draft.peers, supervisors=supervisors)
