"""`SchedulerCore`: all that a scheduler decides, composed of the parts beside this module."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

from afspm.logic.arbiter import CONTROL_EVENTS, Arbiter, ask_of
from afspm.logic.arbitration import ArbitrationState, ControlEvent, ControlInput
from afspm.logic.cache import TIME_STEP_NS, PacketCache
from afspm.logic.controller_timeout import TRANSLATOR, ControllerTimeout
from afspm.logic.coordinate_frame import CoordinateFrame
from afspm.logic.event_log import SCHEDULER, EventLog
from afspm.logic.events import (
    Announced,
    Codec,
    Connected,
    Disconnected,
    Effect,
    Greeted,
    Input,
    Kill,
    Log,
    PacketIn,
    ProblemSeen,
    Publish,
    Replay,
    ReplayRequested,
    Reply,
    RequestIn,
    SaveState,
    Stopped,
    Tick,
    TranslatorCaughtUp,
    TranslatorDown,
    TranslatorReply,
    TranslatorUp,
    Unreadable,
)
from afspm.logic.experiment_end import ExperimentEnd
from afspm.logic.holder_timeout import HolderTimeout
from afspm.logic.lease import Lease
from afspm.logic.lifecycle import StartupBarrier
from afspm.logic.packet_intake import PacketIntake
from afspm.logic.request_pipeline import OwnEnd, RequestPipeline
from afspm.logic.scheduler_publisher import CONTROL_STATE, SchedulerPublisher
from afspm.logic.settings import SchedulerSettings
from afspm.logic.shutdown_grace import ShutdownGrace
from afspm.logic.watchdog import Watchdog
from afspm.model import (
    CLOCK_REQUEST,
    HAS_ENDED,
    RELAY_REQUEST,
    RESTART_REQUEST,
    ControlMode,
    ControlResponse,
    ControlState,
    Feedback,
    LoggedPacket,
    ProbePosition,
    Problem,
    Request,
    Response,
    ResponseDetail,
    ScanParameters,
    ScopeState,
    ScopeStatus,
    component_of,
    names,
)

__all__ = ["CONTROL_STATE", "SchedulerCore", "SchedulerSettings"]

_TELLING = frozenset({"ScopeStateMsg", "ZCtrlParameters", "ScanParameters2d", "ProbePosition"})
"""Messages from which we learn what the microscope is in. All others pass unread."""
_STOPS = {ScopeState.SCANNING: names.STOP_SCAN, ScopeState.SPEC: names.STOP_SPEC}
_AT_ONCE_S = 0.0  # in real monotonic time: always past


class SchedulerCore:
    """The scheduler without its sockets.

        core = SchedulerCore(settings, codec)
        core.restore(state); core.restore_cache(packets)     # after a restart only
        effects = core.start(now_s, now_ns)                  # then, for whatever happens:
        effects = core.step(RequestIn(...), now_s, now_ns)

    Whoever hosts it carries out the effects in their order, and steps with `Tick()` when `deadline_s` or
    `deadline_ns` has come, however much else there is to do.

    Args:
        frame: the coordinates that components speak of, where they are not those of the microscope.
    """

    def __init__(self, settings: SchedulerSettings, codec: Codec, frame: CoordinateFrame | None = None) -> None:
        self._settings = settings
        self._codec = codec
        self._cache = PacketCache(settings.envelopes, settings.cache_bytes)
        self._lease = Lease(None if settings.lease_s is None else round(settings.lease_s * 1e9))
        self._watchdog = Watchdog(settings.watchdog)
        self._controller_timeout = ControllerTimeout(settings.malfunction_after_s)
        self._frame = frame
        self._intake = PacketIntake(self._cache, frame, codec.by_point if settings.spectra_by_variable else None)
        self._startup_barrier = StartupBarrier(settings.catch_up_s)
        self._event_log = chronicle = EventLog(settings.rules.problems)
        self._bulletin = SchedulerPublisher(codec, self._cache, chronicle, settings.rules.roles, self._save)
        self._pipeline = desk = RequestPipeline(
            settings, codec, self._watchdog, self._lease, self._control, self._save, chronicle, frame
        )
        self._sessions, self._forwarder, self._guard = desk.sessions, desk.forwarder, desk.guard
        self._holder_timeout = HolderTimeout(
            desk.sessions, settings.grace_s, settings.restart_grace_s, self._bulletin.telling.over_since_s
        )
        self._ending = ExperimentEnd(settings, desk, self._watchdog)
        self._farewell = ShutdownGrace()
        self._arbiter = Arbiter(
            settings.rules, desk, self._bulletin, chronicle, self._watchdog, self._lease,
            self._startup_barrier, self._ending, self._save,
        )  # fmt: skip
        self._is_restarted = False
        self._recent: list[tuple[int, int]] = []
        self._effects: list[Effect] = []
        self._handlers: dict[type, Callable[[Any, float, int], None]] = {
            RequestIn: self._on_request,
            Unreadable: self._on_unreadable,
            TranslatorReply: self._on_reply,
            PacketIn: self._on_packet,
            Connected: self._on_connected,
            Disconnected: self._on_disconnected,
            Greeted: self._on_greeted,
            ReplayRequested: self._on_subscriber,
            TranslatorUp: self._on_translator_up,
            TranslatorDown: self._on_translator_down,
            TranslatorCaughtUp: self._on_translator_caught_up,
            ProblemSeen: self._on_problem,
            Announced: self._on_announced,
            Stopped: self._on_stopped,
            Tick: self._on_tick,
        }

    # --- life ---

    def start(self, now_s: float, now_ns: int) -> list[Effect]:
        """Begin. The control state is published as soon as the translator's packets have been caught up with."""
        self._effects = self._pipeline.effects = []
        self._holder_timeout.started(now_s)
        self._watchdog.begin(now_s)
        self._lease.held_by(self.control.holder, now_ns)
        self._cache.remember(self._recent)
        self._event_log.at(now_s, now_ns)
        if self.control.ended:
            self._ending.begin(now_s)
            self._end_when_safe(now_s, now_ns)
        else:
            self._startup_barrier.begin(now_s, again=self._is_restarted)
            self._event_log.began(self.control, again=self._is_restarted)
        return self._effects

    def step(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        """Take in what happened; `now_s` is real and monotonic, `now_ns` the experiment's time."""
        self._effects = self._pipeline.effects = []
        self._event_log.at(now_s, now_ns)
        self._handlers[type(event)](event, now_s, now_ns)
        self._end_when_safe(now_s, now_ns)
        return self._with_forwards()

    def _end_when_safe(self, now_s: float, now_ns: int) -> None:
        """The experiment that is over ends, once the tip is out of danger or that takes too long."""
        if self._ending.is_due(now_s):
            self._ending.end()
            self._with_forwards()
            stop = _STOPS.get(self._watchdog.state, "")
            self._effects += [*self._bulletin.entries(now_ns), Kill(not self._watchdog.owes_retract, stop)]
            self._farewell.begin(now_s)

    def _with_forwards(self) -> list[Effect]:
        if self._forwarder.outbox:
            self._effects += self._forwarder.outbox
            self._forwarder.outbox.clear()
        return self._effects

    def deadline_s(self) -> float | None:
        """When, in real monotonic time, a Tick is due at the latest; None: no deadline."""
        soonest_s = self._forwarder.deadline_s()
        others_s = (
            self._dead_at_s(),
            self._startup_barrier.due_s(),
            self._ending.by_s,
            self._pipeline.unclear_until_s(),
            self._pipeline.mover.due_s(),
            self._malfunction()[0],
            self._watchdog.due_s,
            self._entries_due_s(),
        )
        for deadline_s in others_s:
            if deadline_s is not None and (soonest_s is None or deadline_s < soonest_s):
                soonest_s = deadline_s
        return soonest_s

    def deadline_ns(self) -> int | None:
        """When, in experiment time, a Tick is due at the latest; None: no deadline (only a lease makes one)."""
        return self._lease.deadline_ns()

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, but for the cache, as plain JSON."""
        return {
            **self._arbiter.snapshot(),
            "last_ns": self._cache.last_ns,
            "recent": self._cache.recent(),
            "watchdog": self._watchdog.snapshot(),
            "supervisors": self._bulletin.telling.snapshot(),
            **self._pipeline.snapshot(),
            **({} if self._frame is None else {"frame": self._frame.snapshot()}),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote, before `start`.

        Raises:
            KeyError, TypeError, ValueError: it is not what `snapshot` writes.
        """
        self._is_restarted = True
        self._arbiter.restore(state)
        self._cache.not_before(int(state["last_ns"]))
        self._watchdog.restore(state["watchdog"])
        self._recent = [(int(source_ns), int(first_ns)) for source_ns, first_ns in state["recent"]]
        self._bulletin.telling.restore(state.get("supervisors", {}))
        self._pipeline.restore(state)
        if self._frame is not None and "frame" in state:
            self._frame.restore(state["frame"])

    def restore_cache(self, packets: Iterable[LoggedPacket]) -> None:
        """Take up packets that were published (with their `source_ns`), oldest first, before `start`."""
        self._cache.restore(packets)

    def cached(self) -> Iterable[LoggedPacket]:
        """What is cached now (with `source_ns`), oldest first: for whoever tidies the journal."""
        return self._cache

    def ask_own(self, request: Request, now_s: float, ended: OwnEnd) -> list[Effect]:
        """ControlInput the microscope in the scheduler's own name, if it is there."""
        self._effects = self._pipeline.effects = []
        self._pipeline.ask_own(request, now_s, ended)
        return self._with_forwards()

    def put_off(self, until_s: float) -> None:
        """More of what was published before a restart is to come: who is in control is told after that."""
        self._startup_barrier.put_off(until_s)

    @property
    def newest_source_ns(self) -> int:
        """The translator's newest packet that was taken in: where to subscribe from; -1 if there is none."""
        return self._cache.newest_source_ns

    @property
    def leave_at_s(self) -> float:
        """When, in real monotonic time, the scheduler may leave after the end; inf: it has not ended."""
        return self._farewell.until_s

    @property
    def control(self) -> ArbitrationState:
        """Who is in control, for what, and who flagged which problem."""
        return self._arbiter.control

    @property
    def control_state(self) -> ControlState:
        """The same as all peers are told it."""
        return self.control.published()

    # --- peers ---

    def _on_connected(self, event: Connected, now_s: float, now_ns: int) -> None:
        self._sessions.connected(event.connection)

    def _on_disconnected(self, event: Disconnected, now_s: float, now_ns: int) -> None:
        name = self._pipeline.disconnected(event.connection, now_s)
        if name is None:
            return
        if (waiting := self._pipeline.clear_up(name)) is not None:
            self._on_request(waiting, now_s, now_ns)
        elif name == self.control.holder and self._holder_timeout.is_told(now_s):
            self._log("WARNING", f"{name} is in control and gone; it has {self._settings.grace_s:g} s to come back")

    def _on_greeted(self, event: Greeted, now_s: float, now_ns: int) -> None:
        if event.name and (event.user is None or event.user == component_of(event.name)):
            self._sessions.hear(event.connection, event.name, None, now_s)

    def _on_problem(self, event: ProblemSeen, now_s: float, now_ns: int) -> None:
        what = ControlEvent.FLAG if event.flagged else ControlEvent.CLEAR
        self._arbiter.decide(ControlInput(what, event.name, event.problem), None, now_s, now_ns)

    def _on_announced(self, event: Announced, now_s: float, now_ns: int) -> None:
        # what goes before a packet must not put off its time: should that come again after a kill, it is to keep it
        time_ns = now_ns if event.before_ns is None else event.before_ns - TIME_STEP_NS
        self._effects += self._bulletin.announce(event.envelope, event.payload, time_ns)

    def _on_subscriber(self, event: ReplayRequested, now_s: float, now_ns: int) -> None:
        self._effects.append(Replay(event.subscriber, self._cache.replay(event.prefixes, event.since_ns)))

    # --- requests ---

    def _on_request(self, event: RequestIn, now_s: float, now_ns: int) -> None:
        if event.heard_s < 0.0:
            event.heard_s = now_s
        kind = event.request.kind
        if kind in CONTROL_EVENTS and self._startup_barrier.keeps(event):
            return
        if not self._pipeline.take(event, now_s):
            return
        if kind == RELAY_REQUEST:  # a supervisor's last words come after the end
            self._follow(event, self._bulletin.told(event, now_s, now_ns))
            self._farewell.told(self._bulletin.telling.states_of(event.name), now_s)
        elif self.control.ended:
            self._ending.answer(event, ControlResponse.FAILURE, HAS_ENDED, ResponseDetail.EXPERIMENT_ENDED)
        elif kind == RESTART_REQUEST:
            self._follow(event, self._bulletin.ordered(event, now_s))
        elif kind == CLOCK_REQUEST:
            self._tell_time(event, now_ns)
        elif kind <= 0:
            self._pipeline.answer(
                event, ControlResponse.CMD_NOT_SUPPORTED, f"there is no request with the number {kind}"
            )
        else:
            self._arbiter.decide(ask_of(event.name, event.request), event, now_s, now_ns)

    def _tell_time(self, event: RequestIn, now_ns: int) -> None:
        """What all parts of an experiment have in common: the run, what time it is, and how it passes."""
        common = {"run": self._settings.run, "simulated": self._settings.simulated, "now_ns": now_ns}
        told = json.dumps({**self._settings.clock, **common}).encode()
        response = Response(int(ControlResponse.SUCCESS), told, "", event.request.id)
        self._effects.append(Reply(event.connection, event.name, response, CLOCK_REQUEST))

    def _on_unreadable(self, event: Unreadable, now_s: float, now_ns: int) -> None:
        self._event_log.unreadable(event.name, event.response)

    def _follow(self, event: RequestIn, outcome: tuple[list[Effect], Response]) -> None:
        """What followed from something that was told, or ordered, and its answer."""
        effects, response = outcome
        self._effects += effects
        self._pipeline.answer(event, ControlResponse(response.code), response.reason, response.payload)

    # --- the translator ---

    def _on_reply(self, event: TranslatorReply, now_s: float, now_ns: int) -> None:
        settled = self._forwarder.answered(event.number, event.response, now_s)
        if settled is not None:
            self._pipeline.settle(settled, now_s, now_ns)

    def _on_translator_up(self, event: TranslatorUp, now_s: float, now_ns: int) -> None:
        self._pipeline.settle_all(self._forwarder.connected(), now_s, now_ns)
        if event.knows_ids is not None:
            self._pipeline.ids_known = event.knows_ids
        self._pipeline.errands.begin(now_s)
        self._pipeline.read_ahead(now_s)

    def _on_translator_down(self, event: TranslatorDown, now_s: float, now_ns: int) -> None:
        self._pipeline.settle_all(self._forwarder.lost(), now_s, now_ns)

    def _on_translator_caught_up(self, event: TranslatorCaughtUp, now_s: float, now_ns: int) -> None:
        if self._startup_barrier.until_s is not None:
            self._arbiter.publish(now_s, now_ns)

    def _on_packet(self, event: PacketIn, now_s: float, now_ns: int) -> None:
        message = event.header.message
        told = self._codec.decode_packet(message, event.packet.payload) if message in _TELLING else None
        if self._pipeline.mover.is_passing(told):
            if self._cache.pass_over(event.packet):
                self._on_telling(told, now_s, now_ns)
            return
        taken = self._intake.take(event.packet, event.header, now_ns)
        if taken is None:
            return
        self._effects.append(taken)
        if self._pipeline.ids_known is False and (doubt := self._intake.doubted(event.header)) is not None:
            self._effects.append(doubt)
        if isinstance(taken, Publish) and told is not None:
            self._on_telling(told, now_s, now_ns)

    def _on_telling(self, told: object, now_s: float, now_ns: int) -> None:
        if isinstance(told, ScopeStatus):
            self._watchdog.scope_is(told.state)
            self._lease.scope_is(told.state, now_ns)
            self._trust_is(told.state, now_s, now_ns)
            self._pipeline.errands.send(now_s)
            if self._pipeline.mover.busy:
                self._pipeline.act_when_moved(now_s, now_ns)
        elif isinstance(told, Feedback) and self._watchdog.danger.feedback_is(told):
            self._effects.append(self._save())
            self._pipeline.errands.send(now_s)
        if isinstance(told, Feedback | ScanParameters | ProbePosition) and self._guard.published(told, now_ns):
            self._effects.append(self._save())

    def _trust_is(self, state: ScopeState, now_s: float, now_ns: int) -> None:
        self._controller_timeout.scope_is(state, now_s)
        if not self._controller_timeout.lost and self.control.problems.get(Problem.DEVICE_MALFUNCTION) == TRANSLATOR:
            self._arbiter.decide(
                ControlInput(ControlEvent.CLEAR, TRANSLATOR, Problem.DEVICE_MALFUNCTION), None, now_s, now_ns
            )

    def _malfunction(self) -> tuple[float | None, str]:
        """When a problem is made of it that the microscope can't be used, and in whose name; None: it can, or it is
        flagged already."""
        if Problem.DEVICE_MALFUNCTION in self.control.problems or self.control.ended:
            return None, ""
        return (
            (_AT_ONCE_S, SCHEDULER) if self._watchdog.left_to_people else (self._controller_timeout.due_s(), TRANSLATOR)
        )

    # --- time ---

    def _on_stopped(self, event: Stopped, now_s: float, now_ns: int) -> None:
        """Whoever resumes the run finds the tip retracted, or worse. A person in control knows."""
        if self.control.mode is ControlMode.MANUAL:
            return
        danger = self._watchdog.danger.now
        if danger is not None and not self._pipeline.forwarder.up:
            self._log("CRITICAL", f"the run is stopped, {danger}, and no translator is there to retract the tip")
        self._watchdog.leave_to_people()
        self._effects.append(self._save())

    def _on_tick(self, event: Tick, now_s: float, now_ns: int) -> None:
        self._see_to_deadlines(now_s, now_ns)
        entries_due_s = self._entries_due_s()
        if entries_due_s is not None and now_s >= entries_due_s:
            self._effects += self._bulletin.entries(now_ns)

    def _entries_due_s(self) -> float | None:
        """When what has happened is to be published; not while what was before a restart may still come again."""
        return None if self._startup_barrier.until_s is not None else self._event_log.due_s

    def _dead_at_s(self) -> float | None:
        """When control is taken from a holder that is gone, after what was before a restart is told."""
        dead_at_s, told_at_s = self._holder_timeout.dead_at_s(self.control.holder), self._startup_barrier.until_s
        return dead_at_s if dead_at_s is None or told_at_s is None else max(dead_at_s, told_at_s)

    def _see_to_deadlines(self, now_s: float, now_ns: int) -> None:
        # one change of control in a step: it is saved and told before the next is decided
        announce_at_s = self._startup_barrier.until_s
        if announce_at_s is not None and now_s >= announce_at_s:
            self._arbiter.publish(now_s, now_ns)
            return
        if (kept := self._startup_barrier.let_in()) is not None:
            self._on_request(kept, now_s, now_ns)
            return
        malfunction_at_s, told_by = self._malfunction()
        if malfunction_at_s is not None and now_s >= malfunction_at_s:
            if told_by == SCHEDULER:
                self._watchdog.people_called()
                self._log(
                    "WARNING", "the tip was in danger: bring it back to the surface, then clear device-malfunction"
                )
            self._arbiter.decide(
                ControlInput(ControlEvent.FLAG, told_by, Problem.DEVICE_MALFUNCTION), None, now_s, now_ns
            )
            return
        look_at_s = self._watchdog.due_s
        if look_at_s is not None and now_s >= look_at_s:
            told = self._watchdog.look_again(now_s, is_seen_to=self.control.sees_to_tip)
            if told is not None:
                self._log("CRITICAL", told)
            self._effects.append(self._save())
            self._pipeline.errands.send(now_s)
            return
        holder, dead_at_s = self.control.holder, self._dead_at_s()
        if holder is not None and dead_at_s is not None and now_s >= dead_at_s:
            self._arbiter.decide(ControlInput(ControlEvent.DEAD, holder), None, now_s, now_ns)
        lease_ns, holder = self._lease.deadline_ns(), self.control.holder
        if holder is not None and lease_ns is not None and now_ns >= lease_ns:
            self._arbiter.decide(ControlInput(ControlEvent.IDLE, holder), None, now_s, now_ns)
        self._pipeline.refuse_unclear(now_s)
        self._pipeline.act_when_moved(now_s, now_ns)
        self._pipeline.settle_all(self._forwarder.expire(now_s), now_s, now_ns)

    # --- what the parts ask of the whole, and telling people ---

    def _control(self) -> ArbitrationState:
        return self.control

    def _save(self) -> SaveState:
        return SaveState(self.snapshot())

    def _log(self, level: str, text: str) -> None:
        self._effects.append(Log(level, text))
