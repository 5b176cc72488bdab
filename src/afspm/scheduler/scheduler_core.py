"""`SchedulerCore`: all decisions of a scheduler, composed of the modules in this folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from afspm.basics.frozen import replace
from afspm.model import (
    ControlMode,
    ControlResponse,
    ControlState,
    JournalEntries,
    JournalEntry,
    LoggedPacket,
    Problem,
    Response,
    component_of,
)
from afspm.scheduler.control import control_change
from afspm.scheduler.control.arbitration import ArbitrationEvent, ArbitrationState, ControlInput
from afspm.scheduler.control.control_change import TRANSLATOR
from afspm.scheduler.control.holder_timeout import MOST_RESTARTS
from afspm.scheduler.coordinate_frame import (
    TIP_FRAME,
    AskMicroscope,
    CoordinateFrame,
    HoldControl,
    Reconsider,
    SaveNow,
)
from afspm.scheduler.events import (
    Announced,
    Codec,
    Connected,
    ControlChanged,
    Delegate,
    Disconnected,
    Effect,
    FrameAnswered,
    FrameReported,
    Greeted,
    Input,
    Kill,
    Log,
    PacketIn,
    ProblemSeen,
    Replay,
    ReplayRequested,
    RequestIn,
    Started,
    Stopped,
    Tick,
    TranslatorCaughtUp,
    TranslatorDown,
    TranslatorReply,
    TranslatorUp,
    Unreadable,
)
from afspm.scheduler.publishing import own_packets as publishing
from afspm.scheduler.publishing import packet_intake
from afspm.scheduler.publishing.cache import TIME_STEP_NS, PacketCache
from afspm.scheduler.publishing.event_log import SCHEDULER, SentStart, start_entry, unreadable_entry
from afspm.scheduler.requests import answers, approvals, instrument_requests, lending, request_pipeline
from afspm.scheduler.requests.forwarder import AskForFrame
from afspm.scheduler.safety import safety_commands
from afspm.scheduler.safety.forbidden_states import STARTED, PresentState
from afspm.scheduler.safety.limit_checker import is_get
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.state import Environment, SchedulerState, StateDraft, restored_state, saved_state
from afspm.wire.messages import JOURNAL

_MALFUNCTION = Problem.DEVICE_MALFUNCTION
_SICK = "it crashes in its block each time, or does something there that takes longer than its longest_step_s"
_AT_ONCE_S = 0.0  # in real monotonic time: always past


def step(
    state: SchedulerState, event: Input, env: Environment, now_s: float, now_ns: int
) -> tuple[SchedulerState, list[Effect]]:
    """Return the state after an event, and the effects in their order."""
    draft = StateDraft(state, env, now_s, now_ns)
    _dispatch(draft, event)
    while draft.raised:
        _dispatch(draft, draft.raised.pop(0))
    lending.begin_returns(draft)
    request_pipeline.send_next(draft)
    if draft.control is not state.control:
        _dispatch(draft, ControlChanged(state.control, draft.control))
        if draft.control.mode is ControlMode.MANUAL is not state.control.mode:
            lending.say_in_manual(draft)
    approvals.publish_changes(draft)
    lending.publish_changes(draft)
    _end_when_safe(draft)
    return draft.finish()


def _dispatch(draft: StateDraft, event: Input) -> None:
    # the coordinate frame is first: it may keep an event back, or add others
    draft.frame, outputs = draft.frame.step(event, draft.control, draft.now_s, draft.now_ns)
    for output in outputs:
        _HANDLERS[type(output)](draft, output)


def due_s(state: SchedulerState) -> float | None:
    """Return when a Tick is due at the latest, in real monotonic time; None: no deadline."""
    dues = (
        state.due_s(),
        _AT_ONCE_S if instrument_requests.flag_is_due(state) else None,
        _malfunction_due(state)[0],
        _entries_due_s(state),
        _holder_dead_at_s(state),
        _lease_ends_at_s(state),
        lending.due_s(state),
        _AT_ONCE_S if _is_restarted_too_often(state) else None,
    )
    return min((one_s for one_s in dues if one_s is not None), default=None)


class SchedulerCore:
    """The scheduler without its sockets.

        core = SchedulerCore(settings, codec)
        core.restore(saved); core.restore_cache(packets)     # after a restart only
        effects = core.start(now_s, now_ns)                  # then, for each input:
        effects = core.step(RequestIn(...), now_s, now_ns)

    The host carries out the effects in their order. At `deadline_s` or `deadline_ns` it steps with `Tick()`, even while
    other inputs wait.

    Args:
        frame: the map between the coordinates of components and of the microscope; by default both are the same.

    Attributes:
        state: the state that decisions depend on, without the cache; replaced by every step.
    """

    def __init__(self, settings: SchedulerSettings, codec: Codec, frame: CoordinateFrame = TIP_FRAME) -> None:
        self._env = Environment(settings, codec, PacketCache(settings.envelopes, settings.cache_bytes))
        self.state = SchedulerState.initial(settings, frame)
        self._restored: SavedState | None = None

    def start(self, now_s: float, now_ns: int) -> list[Effect]:
        """Start the scheduler, and return the effects.

        The control state is published once the translator's missed packets have arrived, at the latest after
        `Waits.catch_up_s` (a coordinate frame may extend this wait).
        """
        draft, is_restart = StateDraft(self.state, self._env, now_s, now_ns), self._restored is not None
        draft.peers = replace(draft.peers, timeout=replace(draft.peers.timeout, started_s=now_s))
        draft.watchdog = draft.watchdog.begun(now_s)
        draft.instruments = draft.instruments.changed(now_s)  # an earlier life may have changed anything
        draft.lease = draft.lease.held_by(draft.control.holder, now_ns)
        if self._restored is not None:
            draft.lease = draft.lease.asked(self._restored.lease_s, now_s)
            # a start sent before the kill may be known to the translator alone
            until_s = now_s + self._env.settings.control.request_timeout_s
            draft.microscope = draft.microscope.expecting(*STARTED.values(), until_s=until_s)
            draft.others_may_have_acted(unseen=True)
            self._env.cache.remember(self._restored.recent)
            starts = self._restored.starts
            draft.event_log = draft.event_log.restored(starts, self._entries_since(starts), now_s, now_ns)
        if draft.control.ended:
            control_change.begin_end(draft)
            _end_when_safe(draft)
        else:
            draft.barrier = draft.barrier.begin(now_s, is_restart=is_restart)
            entry = start_entry(now_ns, draft.control, is_restart=is_restart)
            draft.event_log = draft.event_log.add(now_s, entry)
        _dispatch(draft, Started())
        self.state, effects = draft.finish()
        return effects

    def step(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        """Process an event, and return the effects; `now_s` is real and monotonic, `now_ns` is experiment time."""
        self.state, effects = step(self.state, event, self._env, now_s, now_ns)
        return effects

    def _entries_since(self, starts: Sequence[SentStart]) -> Iterator[JournalEntry]:
        oldest_ns = min((start.sent_ns for start in starts), default=0)
        for packet, *_ in self._env.cache if starts else ():
            if packet.envelope == JOURNAL.name and (packet.time_ns or 0) >= oldest_ns:
                found = self._env.codec.decode_packet(JOURNAL.name, packet.payload)
                yield from found.entries if isinstance(found, JournalEntries) else ()

    def deadline_s(self) -> float | None:
        """Return when a Tick is due at the latest, in real monotonic time; None: no deadline."""
        return due_s(self.state)

    def deadline_ns(self) -> int | None:
        """Return when a Tick is due at the latest, in experiment time; None: no deadline.

        Deadlines are a lease of the experiment file, the end of an approval (of the agent in control, or of a running
        measurement), the end of the wait for settings, and the return of lent ones.
        """
        lease_ns = self.state.lease.deadline_ns(is_free=self.state.microscope.is_free)
        approved_ns = self.state.grants.ends_ns(self.state.control.holder)
        measured_ns = approvals.measurement_ends_ns(self.state)
        settles_ns = self.state.pending.settles_ns
        returns_ns = lending.return_due_ns(self.state.loans, self._env.settings.control.return_after_s)
        dues = (lease_ns, approved_ns, measured_ns, settles_ns, returns_ns)
        return min((one for one in dues if one is not None), default=None)

    def snapshot(self) -> SavedState:
        """Return the state that must survive a kill, without the cache."""
        return saved_state(self.state, self._env)

    def restore(self, saved: SavedState) -> None:
        """Restore the state of `snapshot`, read back from plain data, before `start`."""
        self._restored = saved
        self.state = restored_state(saved, self._env.settings, self.state.frame)
        self._env.cache.not_before(saved.last_ns)

    def restore_cache(self, packets: Iterable[LoggedPacket]) -> None:
        """Restore published packets (with their `source_ns`), oldest first, before `start`."""
        logged = list(packets)
        self._env.cache.restore(logged)
        self.state = replace(self.state, frame=self.state.frame.recalled(logged))

    def cached(self) -> Iterable[LoggedPacket]:
        """Return the packets in the cache (with `source_ns`), oldest first."""
        return self._env.cache

    def newest(self) -> Mapping[str, int]:
        """Return the time of the newest cached packet of each envelope."""
        return self._env.cache.newest()

    @property
    def newest_source_ns(self) -> int:
        """The translator's time of the packet that it sent last, to subscribe from; -1 if there is none."""
        return self._env.cache.newest_source_ns

    @property
    def leave_at_s(self) -> float:
        """The real monotonic time at which the scheduler exits after the end; inf: the experiment has not ended."""
        return self.state.end.leave_at_s

    @property
    def control(self) -> ArbitrationState:
        """The state of control: mode, holder, the holder's problem, and the flagged problems with their authors."""
        return self.state.control

    @property
    def control_state(self) -> ControlState:
        """The state of control as it is published."""
        return self.control.published()


# --- peers ----------------------------------------------------------------------------------------------------------


def _on_connected(draft: StateDraft, event: Connected) -> None:
    draft.peers = replace(draft.peers, sessions=draft.peers.sessions.connected(event.connection))


def _on_disconnected(draft: StateDraft, event: Disconnected) -> None:
    draft.pending = replace(draft.pending, refused=draft.pending.refused - {event.connection})
    sessions, name = draft.peers.sessions.disconnected(event.connection, draft.now_s)
    draft.peers = replace(draft.peers, sessions=sessions)
    if name is None:
        return
    draft.pending, waiting = draft.pending.clear_up(name)
    timeout = draft.peers.timeout
    if waiting is not None:
        request_pipeline.handle(draft, waiting)
    elif name == draft.control.holder and draft.now_s >= timeout.next_loss_log_s:
        draft.peers = replace(draft.peers, timeout=timeout.loss_logged(draft.now_s))
        draft.log(
            "WARNING", f"lost contact with {name}, which is in control; it has {timeout.grace_s:g} s to come back"
        )


def _on_greeted(draft: StateDraft, event: Greeted) -> None:
    if event.name and (event.user is None or event.user == component_of(event.name)):
        sessions, _ = draft.peers.sessions.hear(event.connection, event.name, None, draft.now_s)
        draft.peers = replace(draft.peers, sessions=sessions)


def _on_unreadable(draft: StateDraft, event: Unreadable) -> None:
    entry = unreadable_entry(draft.now_ns, event.name, event.response)
    draft.event_log = draft.event_log.add_request(draft.now_s, entry)


def _on_replay_requested(draft: StateDraft, event: ReplayRequested) -> None:
    draft.effects.append(Replay(event.subscriber, draft.env.cache.replay(event.prefixes, event.since_ns)))


def _on_problem(draft: StateDraft, event: ProblemSeen) -> None:
    what = ArbitrationEvent.FLAG if event.flagged else ArbitrationEvent.CLEAR
    control_change.decide(draft, ControlInput(what, event.name, event.problem))


def _on_announced(draft: StateDraft, event: Announced) -> None:
    # a time just before the packet's own, so that the packet keeps its time when it comes again after a kill
    time_ns = None if event.before_ns is None else event.before_ns - TIME_STEP_NS
    publishing.publish(draft, event.envelope, event.payload, time_ns)


# --- the translator -------------------------------------------------------------------------------------------------


def _on_reply(draft: StateDraft, event: TranslatorReply) -> None:
    draft.forwarder, settled = draft.forwarder.answered(event.number, event.response)
    if settled is not None:
        draft.watchdog = draft.watchdog.translator_answered()
        request_pipeline.settle(draft, settled)


def _on_translator_up(draft: StateDraft, event: TranslatorUp) -> None:
    draft.forwarder, settled = draft.forwarder.connected()
    for one in settled:
        request_pipeline.settle(draft, one)
    draft.others_may_have_acted(unseen=True)
    draft.loans = replace(draft.loans, is_compared=True)
    safety_commands.begin(draft)
    request_pipeline.read_ahead(draft)


def _on_translator_down(draft: StateDraft, event: TranslatorDown) -> None:
    draft.forwarder, settled = draft.forwarder.lost()
    for one in settled:
        request_pipeline.settle(draft, one)


def _on_translator_caught_up(draft: StateDraft, event: TranslatorCaughtUp) -> None:
    if draft.barrier.until_s is not None:
        publishing.publish_control(draft)


# --- the coordinate frame ------------------------------------------------------------------------------------------


def _on_reconsidered(draft: StateDraft, output: Reconsider) -> None:
    _dispatch(draft, output.event)


def _on_ask_microscope(draft: StateDraft, output: AskMicroscope) -> None:
    if draft.control.mode is ControlMode.MANUAL and not is_get(output.request):
        why = "the mode is MANUAL: a person is in control"
        refused = Response(int(ControlResponse.WRONG_CONTROL_MODE), b"", why, output.request.id)
        draft.raised.append(FrameAnswered(output.purpose, refused))
        return
    # the values, and not who may set them: no component asks
    refusal = draft.limits.check(SCHEDULER, output.request, draft.now_ns, used=())
    # a command in flight may change the known values, so none counts for the forbidden states
    refusal = refusal or draft.limits.check_forbidden(output.request, PresentState())
    if refusal is not None:
        draft.raised.append(FrameAnswered(output.purpose, refusal))
        return
    draft.forwarder, _ = draft.forwarder.ask_own(output.request, draft.now_s, AskForFrame(output.purpose))


def _on_hold_control(draft: StateDraft, output: HoldControl) -> None:
    draft.barrier = draft.barrier.put_off(output.until_s)


def _on_save_now(draft: StateDraft, output: SaveNow) -> None:
    draft.save()


def _add_effect(draft: StateDraft, output: Log | Delegate) -> None:
    draft.effects.append(output)


def _on_frame_input(draft: StateDraft, event: Input) -> None:
    # only a coordinate frame acts on these, in its `step`
    ...


# --- the end, and time ----------------------------------------------------------------------------------------------


def _on_stopped(draft: StateDraft, event: Stopped) -> None:
    # the run may be resumed: its loans are then set back first
    draft.loans = draft.loans.ended(draft.loans.loans)
    # a tip in danger is then retracted, or a person is called; a person in control knows of it
    if draft.control.mode is ControlMode.MANUAL:
        return
    danger = draft.microscope.danger
    if danger is not None and not draft.forwarder.up:
        draft.log("CRITICAL", f"the run is stopped, {danger}, and no translator is there to retract the tip")
    draft.watchdog = draft.watchdog.leave_to_people(draft.microscope)
    draft.save()


def _end_when_safe(draft: StateDraft) -> None:
    owes_retract, kept = draft.watchdog.owes_retract, draft.end.kept
    is_lent = lending.is_to_return(draft.loans) and lending.may_return(draft)
    if not draft.end.is_due(draft.now_s, waits=owes_retract or is_lent):
        return
    draft.end = draft.end.ended(draft.now_s)
    if owes_retract:
        draft.log("CRITICAL", "the experiment ended with the tip in danger: the microscope did not retract it")
    for loan in draft.loans.loans.values():
        why = f": {loan.why}" if loan.why else ""
        draft.log("WARNING", f"the experiment ended with {loan.text}; it was not set back{why}")
    for event, code, why, detail in kept:
        newest = draft.peers.sessions.connection_of(event.name)
        # a client that lost its connection repeats its request over a new one
        if event.request.id and newest is not None:
            event = replace(event, connection=newest)
        answers.answer(draft, event, code, why, detail=detail)
    draft.send_forwards()
    publishing.publish_entries(draft)
    draft.effects.append(Kill(not owes_retract))


def _on_tick(draft: StateDraft, event: Tick) -> None:
    _handle_deadlines(draft)
    entries_due_s = _entries_due_s(draft)
    if entries_due_s is not None and draft.now_s >= entries_due_s:
        publishing.publish_entries(draft)


def _handle_deadlines(draft: StateDraft) -> None:
    instrument_requests.expire(draft)
    # at most one change of control in a step: it is saved and published before the next is decided
    for see_to in (_open_barrier, _flag_malfunction, instrument_requests.flag, _run_watchdog):
        if see_to(draft):
            return
    if (holder := draft.control.holder) is not None and _is_due(_holder_dead_at_s(draft), draft.now_s):
        control_change.decide(draft, ControlInput(ArbitrationEvent.DEAD, holder))
    elif holder is not None and _is_restarted_too_often(draft):
        draft.log(
            "ERROR", f"{holder} was restarted {MOST_RESTARTS} times without giving control back, and loses it: {_SICK}"
        )
        control_change.decide(draft, ControlInput(ArbitrationEvent.DEAD, holder))
    lease_ns = draft.lease.deadline_ns(is_free=draft.microscope.is_free)
    is_idle = (lease_ns is not None and draft.now_ns >= lease_ns) or _is_due(_lease_ends_at_s(draft), draft.now_s)
    if (holder := draft.control.holder) is not None and is_idle:
        control_change.decide(draft, ControlInput(ArbitrationEvent.IDLE, holder))
    approvals.end(draft)
    for name in draft.pending.still_unclear(draft.now_s):  # both connections stay open: they belong to two processes
        draft.pending, waiting = draft.pending.clear_up(name)
        if waiting is not None:
            request_pipeline.refuse_second(draft, waiting)
    draft.forwarder, settled = draft.forwarder.expired(draft.now_s)
    for one in settled:
        request_pipeline.settle(draft, one)


def _open_barrier(draft: StateDraft) -> bool:
    if _is_due(draft.barrier.until_s, draft.now_s):
        publishing.publish_control(draft)
        return True
    draft.barrier, kept = draft.barrier.let_in()
    if kept is not None:
        request_pipeline.handle(draft, kept)
    return kept is not None


def _flag_malfunction(draft: StateDraft) -> bool:
    at_s, flagged_by = _malfunction_due(draft)
    if not _is_due(at_s, draft.now_s):
        return False
    if flagged_by == SCHEDULER:
        draft.watchdog = draft.watchdog.people_called()
        draft.log("WARNING", "the tip was in danger: bring it back to the surface, then clear device-malfunction")
    control_change.decide(draft, ControlInput(ArbitrationEvent.FLAG, flagged_by, _MALFUNCTION))
    return True


def _run_watchdog(draft: StateDraft) -> bool:
    if not _is_due(draft.watchdog.due_s, draft.now_s):
        return False
    is_seen_to = draft.control.sees_to_tip
    draft.watchdog, notice = draft.watchdog.look_again(draft.microscope, draft.now_s, is_seen_to=is_seen_to)
    if notice is not None:
        draft.log("CRITICAL", notice)
    safety_commands.send(draft)
    return True


def _is_due(due_s: float | None, now_s: float) -> bool:
    return due_s is not None and now_s >= due_s


def _entries_due_s(state: SchedulerState | StateDraft) -> float | None:
    # not before the startup barrier opens: older entries may still be published by then
    return None if state.barrier.until_s is not None else state.event_log.due_s


def _holder_dead_at_s(state: SchedulerState | StateDraft) -> float | None:
    # not before the startup barrier opens: the state of before the restart is published first
    holder, opens_at_s = state.control.holder, state.barrier.until_s
    if holder is None:
        return None
    dead_at_s = state.peers.dead_at_s(holder)
    return dead_at_s if dead_at_s is None or opens_at_s is None else max(dead_at_s, opens_at_s)


def _is_restarted_too_often(state: SchedulerState | StateDraft) -> bool:
    # not during a scan, which a restarted component waits for and keeps
    holder = state.control.holder
    if holder is None or state.barrier.until_s is not None or not state.microscope.is_free:
        return False
    return state.lease.is_restarted_too_often(state.peers.supervisors.starts_of(component_of(holder)))


def _lease_ends_at_s(state: SchedulerState | StateDraft) -> float | None:
    # not before the startup barrier opens: the state of before the restart is published first
    until_s, opens_at_s = state.lease.asked_until_s(), state.barrier.until_s
    return until_s if until_s is None or opens_at_s is None else max(until_s, opens_at_s)


def _malfunction_due(state: SchedulerState | StateDraft) -> tuple[float | None, str]:
    # (time at which device-malfunction will be flagged, or None; the name that flags it)
    if _MALFUNCTION in state.control.problems or state.control.ended:
        return None, ""
    return (_AT_ONCE_S, SCHEDULER) if state.watchdog.left_to_people else (state.microscope.lost_at_s, TRANSLATOR)


_HANDLERS: dict[type, Callable[[StateDraft, Any], None]] = {
    RequestIn: request_pipeline.handle,
    Unreadable: _on_unreadable,
    TranslatorReply: _on_reply,
    PacketIn: packet_intake.take_packet,
    Connected: _on_connected,
    Disconnected: _on_disconnected,
    Greeted: _on_greeted,
    ReplayRequested: _on_replay_requested,
    TranslatorUp: _on_translator_up,
    TranslatorDown: _on_translator_down,
    TranslatorCaughtUp: _on_translator_caught_up,
    ProblemSeen: _on_problem,
    Announced: _on_announced,
    Stopped: _on_stopped,
    Tick: _on_tick,
    Reconsider: _on_reconsidered,
    AskMicroscope: _on_ask_microscope,
    HoldControl: _on_hold_control,
    SaveNow: _on_save_now,
    Log: _add_effect,
    Delegate: _add_effect,
    Started: _on_frame_input,
    FrameReported: _on_frame_input,
    FrameAnswered: _on_frame_input,
    ControlChanged: _on_frame_input,
}
"""The handler for each type of input and of frame output."""
