"""Packets of the translator: each gets an envelope, a time and coordinates; a state updates the microscope's status."""

from __future__ import annotations

from afspm import wire
from afspm.basics.errors import AfspmError
from afspm.basics.frozen import replace
from afspm.model import (
    ActByHand,
    ControlMode,
    Feedback,
    Packet,
    PacketHeader,
    Parameter,
    ProbePosition,
    Problem,
    Role,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    TipStatus,
    names,
)
from afspm.scheduler.control import control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, ControlInput
from afspm.scheduler.control.control_change import TRANSLATOR
from afspm.scheduler.events import PacketIn, Publish
from afspm.scheduler.publishing.event_log import panel_entry
from afspm.scheduler.requests import approvals, lending
from afspm.scheduler.safety import safety_commands
from afspm.scheduler.safety.movers import MoverState
from afspm.scheduler.state import StateDraft
from afspm.wire.messages import CONTROL_STATE

# bounded, since the texts contain names that come from a peer
_MOST_LOGGED = 1000
_STATE, _TRANSLATOR = wire.MessageKind.STATE, Role.TRANSLATOR


def take_packet(draft: StateDraft, event: PacketIn) -> None:
    """Publish a packet, and update the status of the microscope from a published state.

    A duplicate, a `ControlState` and a packet without a valid envelope are dropped. A state hidden during a move before
    an action updates the status without publication.
    """
    message, codec, move = event.header.message, draft.env.codec, draft.pending.move
    # only states are decoded: no decision depends on other messages, and scans are large
    reported = codec.decode_packet(message, event.packet.payload) if _is_state(message) else None
    if move is not None and move.hides(reported):
        if draft.env.cache.pass_over(event.packet):
            _update_state(draft, reported)
        return
    published = _published(draft, event.packet, event.header)
    if published is None:
        return
    draft.effects.append(published)
    if reported is not None:
        _update_state(draft, reported)


def _is_state(message: str) -> bool:
    known = wire.declaration(message)
    return known.kind is _STATE and known.source is _TRANSLATOR


def _published(draft: StateDraft, packet: Packet, header: PacketHeader) -> Publish | None:
    env, source_ns = draft.env, packet.time_ns
    if header.message == CONTROL_STATE.name:
        _log_once(draft, "WARNING", "the translator publishes a ControlState, which is the scheduler's: dropped")
        return None
    try:
        draft.frame, packet = draft.frame.incoming(packet, header, draft.now_ns)
        taken = env.cache.take(packet, header, draft.now_ns)
    except AfspmError as error:
        _log_once(draft, "ERROR", f"{header.message} is not published: {error}")
        return None
    return None if taken is None else Publish(taken[0], source_ns, taken[1])


def _log_once(draft: StateDraft, level: str, text: str) -> None:
    if text not in draft.logged and len(draft.logged) < _MOST_LOGGED:
        draft.logged |= {text}
        draft.log(level, text)


def _update_state(draft: StateDraft, published: object) -> None:
    if isinstance(published, ScopeStatus):
        _update_scope_state(draft, published.state)
    elif isinstance(published, Feedback):
        before, draft.microscope = draft.microscope, draft.microscope.with_feedback(published)
        is_manual = draft.control.mode is ControlMode.MANUAL
        draft.by_hand = draft.by_hand.published(published, is_manual=is_manual)
        if draft.microscope.risk != before.risk:
            safety_commands.send(draft)
    elif isinstance(published, TipStatus):
        is_back = published.engaged is True and draft.panel.tip.engaged is not True
        draft.panel = replace(draft.panel, tip=published)
        if published.engaged:
            draft.microscope = draft.microscope.with_tip(away=False)
            is_by_hand = draft.control.mode is ControlMode.MANUAL
            draft.limits = draft.limits.with_movers(lambda state: state.at_sample(is_back=is_back, by_hand=is_by_hand))
        if published.remedy:  # the act itself may have been lost with its translator
            _give_to_person(draft, published.by_hand)
    elif isinstance(published, ActByHand):
        _take_act(draft, published)
    if isinstance(published, Feedback | ScanParameters | ProbePosition):
        draft.limits = draft.limits.published(published, draft.now_ns)


def _take_act(draft: StateDraft, act: ActByHand) -> None:
    is_manual, control = draft.control.mode is ControlMode.MANUAL, draft.env.settings.control
    draft.others_may_have_acted(is_watched=not is_manual)
    if any(one.parameter == names.SCAN_SIZE_X for one in act.changes):
        # behind the speed of some makers stands a line rate: another width is no decision about the speed
        draft.loans = draft.loans.unwatched(names.SCAN_SPEED)
    values = [Parameter(one.parameter, one.after, one.unit or None) for one in act.changes]
    draft.limits = draft.limits.seen(values)
    for value in values:
        draft.panel = draft.panel.with_change(value.name, draft.limits.outside(value))
        draft.limits = draft.limits.in_force(value, draft.now_ns)
    outside = [draft.panel.outside[one.parameter] for one in act.changes if one.parameter in draft.panel.outside]
    draft.event_log = draft.event_log.add(draft.now_s, panel_entry(draft.now_ns, TRANSLATOR, act, outside))
    pauses = draft.panel.asks_for_pause(act, stopped=control.stopped_by_hand, changed=control.changed_by_hand)
    for one, value in zip(act.changes, values, strict=True):
        if is_manual or pauses:  # what leads to MANUAL is set in it
            draft.by_hand = draft.by_hand.changed(one)
        else:
            lending.turned(draft, value)
    if pauses:
        _give_to_person(draft, "; ".join([str(act), *outside]))


def _give_to_person(draft: StateDraft, why: str) -> None:
    draft.panel = replace(draft.panel, why=draft.panel.why or why)
    safety_commands.leave_to_person(draft)
    control_change.decide(draft, ControlInput(ArbitrationEvent.BY_HAND, TRANSLATOR, why=why))


def _update_scope_state(draft: StateDraft, state: ScopeState) -> None:
    before = draft.microscope
    draft.microscope = before.with_state(state, draft.now_s)
    draft.loans = draft.loans.in_state(is_free=state is ScopeState.FREE, now_ns=draft.now_ns)
    if state is ScopeState.FREE:
        draft.limits = draft.limits.with_movers(MoverState.free)
    elif state is ScopeState.INTERRUPTED:
        draft.limits = draft.limits.with_movers(MoverState.interrupted)
    elif state is ScopeState.COARSE_MOTOR:
        shown = draft.panel.tip.engaged
        draft.limits = draft.limits.with_movers(lambda movers: movers.motor_moves(engaged=shown))
    elif state is ScopeState.UNDEFINED:
        draft.others_may_have_acted(unseen=True)
    draft.watchdog = draft.watchdog.state_reported(draft.microscope)
    approvals.state_changed(draft, before)
    if draft.microscope.is_free != before.is_free:
        draft.lease = draft.lease.used(draft.now_ns)
    flagged_by = draft.control.problems.get(Problem.DEVICE_MALFUNCTION)
    # only the flag raised for the translator: a flag of a component waits for a person (decision 0016)
    if draft.microscope.lost_since_s is None and flagged_by == TRANSLATOR:
        control_change.decide(draft, ControlInput(ArbitrationEvent.CLEAR, TRANSLATOR, Problem.DEVICE_MALFUNCTION))
    safety_commands.send(draft)
