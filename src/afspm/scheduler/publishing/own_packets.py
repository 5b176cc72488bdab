"""The scheduler's own packets: control, the event log, and messages that it publishes for other processes."""

from __future__ import annotations

from afspm import wire
from afspm.basics.frozen import replace
from afspm.model import HAS_ENDED, ControlResponse, ProcessStates, ResponseDetail, component_of
from afspm.scheduler.control.arbitration import may
from afspm.scheduler.control.supervisor_registry import SupervisorRegistry, announcement
from afspm.scheduler.events import Publish, RequestIn
from afspm.scheduler.requests import answers
from afspm.scheduler.state import StateDraft
from afspm.wire.messages import CONTROL_STATE, JOURNAL, NOTE


def publish(draft: StateDraft, envelope: str, payload: bytes, time_ns: int | None = None) -> None:
    """Publish a packet of the scheduler itself.

    The time of the packet is saved first, so that no later packet gets the same time.

    Args:
        time_ns: the earliest time of the packet; None: the time of the step.
    """
    packet, history = draft.env.cache.stamp(envelope, payload, draft.now_ns if time_ns is None else time_ns)
    draft.effects.append(Publish(packet, None, history))
    draft.save()


def publish_control(draft: StateDraft) -> None:
    """Publish the control state, and open the startup barrier."""
    draft.barrier = draft.barrier.opened(draft.now_s)
    publish(draft, CONTROL_STATE.name, draft.env.codec.encode(draft.control.published()))


def publish_entries(draft: StateDraft) -> None:
    draft.event_log, entries = draft.event_log.take(draft.env.settings.rules.problems, draft.now_ns)
    if entries.entries:
        publish(draft, JOURNAL.name, draft.env.codec.encode(entries))


def publish_for_process(draft: StateDraft, event: RequestIn) -> None:
    """Publish a message for a process, or refuse the message; the answer to a supervisor carries its orders."""
    announced = announcement(event, draft.env.codec)
    if not announced.envelope:
        answers.answer(draft, event, ControlResponse.FAILURE, announced.why)
        return
    if draft.control.ended and announced.envelope == NOTE.name:  # on this refusal its author writes it into the record
        ended = ResponseDetail.EXPERIMENT_ENDED
        answers.answer(draft, event, ControlResponse.FAILURE, HAS_ENDED, detail=ended)
        return
    if announced.reported is not None:
        _take_report(draft, event.name, announced.reported)
    supervisors, orders = draft.peers.supervisors.orders_for(event.name)
    _replace_supervisors(draft, supervisors)
    payload = event.request.subject.payload
    # a retry of a message that was published already: a kill came before its answer
    if announced.may_repeat or not draft.env.cache.holds(announced.envelope, payload):
        publish(draft, announced.envelope, payload)
    answers.answer(draft, event, ControlResponse.SUCCESS, payload=wire.encode_orders(orders))
    draft.end = draft.end.processes_reported(draft.peers.supervisors.states_of(event.name), draft.now_s)


def _take_report(draft: StateDraft, supervisor: str, report: ProcessStates) -> None:
    reported = draft.peers.supervisors.reported(supervisor, report.processes, draft.now_s)
    speed = float(draft.env.settings.run.clock.get("speed", 1.0))
    compared, warning = reported.clock_compared(supervisor, report.time_ns, draft.now_ns, speed)
    _replace_supervisors(draft, compared)
    if (holder := draft.control.holder) is not None:
        draft.lease = draft.lease.reported(compared.starts_of(component_of(holder)))
    for name in draft.plans.stated:
        if compared.over_since_s(component_of(name)) is not None:
            draft.plans = draft.plans.ended(name)
    if warning:
        draft.log("WARNING", warning)


def order_restart(draft: StateDraft, event: RequestIn) -> None:
    """Order the restart of a process, if the client has the role `restart`."""
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
