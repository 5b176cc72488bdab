"""`SchedulerCore`: all that a scheduler decides, composed of the parts beside this module."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from afspm.errors import AfspmError
from afspm.logic import arbitration
from afspm.logic.arbitration import Ask, Cause, Control, Do, Event, Rules
from afspm.logic.cache import Cache
from afspm.logic.envelopes import Envelopes
from afspm.logic.events import (
    Codec,
    ComponentDied,
    Connected,
    Disconnected,
    Effect,
    Greeted,
    Input,
    Kill,
    Log,
    PacketIn,
    Publish,
    Replay,
    Reply,
    RequestIn,
    SaveState,
    SubscriberJoined,
    Tick,
    TranslatorCaughtUp,
    TranslatorDown,
    TranslatorReply,
    TranslatorUp,
)
from afspm.logic.forwarding import UNKNOWN, End, Forwarder, Job, Settled
from afspm.logic.lease import Lease
from afspm.logic.limits import Guard, Limits
from afspm.logic.once import Fate, OnceTable, fingerprint
from afspm.logic.sessions import Hearing, Sessions
from afspm.logic.watchdog import Result, Watchdog, WatchdogSettings
from afspm.model import (
    ControlRequest,
    ControlResponse,
    ControlState,
    Feedback,
    Packet,
    PacketHeader,
    Parameter,
    ProbePosition,
    Request,
    Response,
    ScanParameters,
    ScopeStatus,
    names,
)

CONTROL_STATE = "ControlState"

_TELLING = frozenset({"ScopeStateMsg", "ZCtrlParameters", "ScanParameters2d", "ProbePosition"})
"""Messages from which we learn what the microscope is in. All others pass unread."""

_CONTROL_EVENTS = {
    int(ControlRequest.REQUEST_CTRL): Event.REQUEST_CONTROL,
    int(ControlRequest.RELEASE_CTRL): Event.RELEASE_CONTROL,
    int(ControlRequest.ADD_EXP_PRBLM): Event.FLAG,
    int(ControlRequest.RMV_EXP_PRBLM): Event.CLEAR,
    int(ControlRequest.SET_CONTROL_MODE): Event.SET_MODE,
    int(ControlRequest.END_EXPERIMENT): Event.END,
}
_ACTION, _PARAM = int(ControlRequest.ACTION), int(ControlRequest.PARAM)
_ACTION_SUPPORT, _SUCCESS = int(ControlRequest.ACTION_SUPPORT), int(ControlResponse.SUCCESS)
_SENT_REMEMBERED = 100
_PROBE_ID = "scheduler/are-ids-known"


@dataclass(frozen=True)
class SchedulerSettings:
    """What the experiment file says of a scheduler.

    Attributes:
        rules: roles and problems.
        grace_s: how long (real) a holder that is gone stays in control.
        restart_grace_s: the same for one that has not been heard of since the scheduler itself was restarted.
        lease_s: how long (experiment) a holder may do nothing while the microscope is free; None: as it likes.
        request_timeout_s: within which (real) a request to the translator is answered, by us if it must be.
        patience_s: how much longer the line to the translator is kept for an answer that is overdue.
        longest_queue: how many requests may wait for the translator.
        takeover_s: see `Sessions`.
        cache_bytes: how much is cached at most.
        catch_up_s: how long (real) a scheduler waits at its start for what the translator has published before.
    """

    rules: Rules = field(default_factory=Rules)
    grace_s: float = 10.0
    restart_grace_s: float = 30.0
    lease_s: float | None = None
    request_timeout_s: float = 5.0
    patience_s: float = 5.0
    longest_queue: int = 64
    takeover_s: float = 3.0
    watchdog: WatchdogSettings = field(default_factory=WatchdogSettings)
    limits: Limits = field(default_factory=Limits)
    envelopes: Envelopes = field(default_factory=Envelopes)
    cache_bytes: int = 512 * 2**20
    catch_up_s: float = 1.0


class SchedulerCore:
    """The scheduler without its sockets.

        core = SchedulerCore(settings, codec)
        core.restore(state); core.restore_cache(packets)     # after a restart only
        effects = core.start(now_s, now_ns)                  # then, for whatever happens:
        effects = core.step(RequestIn(...), now_s, now_ns)

    Whoever hosts it carries out the effects in their order, and steps with `Tick()` when `deadline_s` or
    `deadline_ns` has come, however much else there is to do.
    """

    def __init__(self, settings: SchedulerSettings, codec: Codec) -> None:
        self._settings = settings
        self._codec = codec
        self._rules = settings.rules
        self._control = Control()
        self._sessions = Sessions(settings.takeover_s)
        self._once = OnceTable()
        self._forwarder = Forwarder(settings.request_timeout_s, settings.patience_s, settings.longest_queue)
        self._cache = Cache(settings.envelopes, settings.cache_bytes)
        self._guard = Guard(settings.limits)
        self._lease = Lease(None if settings.lease_s is None else round(settings.lease_s * 1e9))
        self._watchdog = Watchdog(settings.watchdog)
        self._started_s = 0.0
        self._announce_at_s: float | None = None
        self._recent: list[tuple[int, int]] = []
        self._missed_again_s = -math.inf
        self._probe: Job | None = None
        self._ids_known: bool | None = None
        # actions that only we know of: a translator of version 1 would do them again
        self._sent: deque[tuple[str, str, int]] = deque(maxlen=_SENT_REMEMBERED)
        self._told: set[object] = set()
        self._effects: list[Effect] = []
        self._handlers: dict[type, Callable[[Any, float, int], None]] = {
            RequestIn: self._on_request,
            TranslatorReply: self._on_reply,
            PacketIn: self._on_packet,
            Connected: self._on_connected,
            Disconnected: self._on_disconnected,
            Greeted: self._on_greeted,
            SubscriberJoined: self._on_subscriber,
            TranslatorUp: self._on_translator_up,
            TranslatorDown: self._on_translator_down,
            TranslatorCaughtUp: self._on_translator_caught_up,
            ComponentDied: self._on_died,
            Tick: self._on_tick,
        }

    # --- life ---

    def start(self, now_s: float, now_ns: int) -> list[Effect]:
        """Begin. The control state is published as soon as the translator's packets have been caught up with."""
        self._effects = []
        self._started_s = now_s
        self._lease.held_by(self._control.holder, now_ns)
        self._cache.remember(self._recent)
        if self._control.ended:
            self._effects.append(Kill())
        else:  # first, in the order of time, what the translator published before we were there
            self._announce_at_s = now_s + self._settings.catch_up_s
        return self._effects

    def step(self, event: Input, now_s: float, now_ns: int) -> list[Effect]:
        """Take in what happened; `now_s` is real and monotonic, `now_ns` the experiment's time."""
        self._effects = []
        self._handlers[type(event)](event, now_s, now_ns)
        if self._forwarder.outbox:
            self._effects += self._forwarder.outbox
            self._forwarder.outbox.clear()
        return self._effects

    def deadline_s(self) -> float | None:
        """When, in real monotonic time, a Tick is due at the latest; None: no deadline."""
        soonest_s = self._forwarder.deadline_s()
        for deadline_s in (self._holder_dead_at_s(), self._announce_at_s):
            if deadline_s is not None and (soonest_s is None or deadline_s < soonest_s):
                soonest_s = deadline_s
        return soonest_s

    def deadline_ns(self) -> int | None:
        """When, in experiment time, a Tick is due at the latest; None: no deadline (only a lease makes one)."""
        return self._lease.deadline_ns()

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, but for the cache, as plain JSON."""
        return {
            "control": self._control.to_dict(),
            "last_ns": self._cache.last_ns,
            "recent": self._cache.recent(),
            "wanted": list(self._watchdog.wanted),
            "sent": list(self._sent),
            "sessions": self._sessions.tokens(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote, before `start`.

        Raises:
            KeyError, TypeError, ValueError: it is not what `snapshot` writes.
        """
        self._control = Control.from_dict(state["control"])
        self._cache.not_before(int(state["last_ns"]))
        self._watchdog.restore(map(str, state["wanted"]))
        self._recent = [(int(source_ns), int(first_ns)) for source_ns, first_ns in state["recent"]]
        self._sessions.restore(state["sessions"])
        for client, request_id, print_ in state["sent"]:
            self._sent.append((client, request_id, print_))
            self._once.restore(client, request_id, print_, Fate.UNKNOWN)

    def restore_cache(self, packets: Iterable[tuple[Packet, int | None]]) -> None:
        """Take up packets that were published (with their `source_ns`), oldest first, before `start`."""
        self._cache.restore(packets)

    def cached(self) -> Iterable[tuple[Packet, int | None]]:
        """What is cached now (with `source_ns`), oldest first: for whoever tidies the journal."""
        return self._cache

    @property
    def newest_source_ns(self) -> int:
        """The translator's newest packet that was taken in: where to subscribe from; -1 if there is none."""
        return self._cache.newest_source_ns

    @property
    def control(self) -> Control:
        """Who is in control, for what, and who flagged which problem."""
        return self._control

    @property
    def control_state(self) -> ControlState:
        """The same as all peers are told it."""
        return self._control.published()

    # --- peers ---

    def _on_connected(self, event: Connected, now_s: float, now_ns: int) -> None:
        self._sessions.connected(event.connection)

    def _on_disconnected(self, event: Disconnected, now_s: float, now_ns: int) -> None:
        name = self._sessions.disconnected(event.connection, now_s)
        self._told.discard(event.connection)
        if name is not None and name == self._control.holder and now_s >= self._missed_again_s:
            self._missed_again_s = now_s + self._settings.grace_s
            self._log("WARNING", f"{name} is in control and gone; it has {self._settings.grace_s:g} s to come back")

    def _on_greeted(self, event: Greeted, now_s: float, now_ns: int) -> None:
        if event.name and (event.user is None or event.user == event.name):
            self._sessions.hear(event.connection, event.name, "", now_s)

    def _on_died(self, event: ComponentDied, now_s: float, now_ns: int) -> None:
        self._arbitrate(Ask(Event.DEAD, event.name), None, now_s, now_ns)

    def _on_subscriber(self, event: SubscriberJoined, now_s: float, now_ns: int) -> None:
        self._effects.append(Replay(event.subscriber, self._cache.replay(event.prefixes, event.since_ns)))

    # --- requests ---

    def _on_request(self, event: RequestIn, now_s: float, now_ns: int) -> None:
        name, request = event.name, event.request
        hearing = self._hear(event, now_s)
        if hearing is not Hearing.ACCEPTED:
            return
        if request.id:
            outcome = self._once.look_up(name, request)
            if outcome is not None and self._repeated(event, outcome, now_s):
                return
        kind = request.kind
        control_event = _CONTROL_EVENTS.get(kind)
        if self._control.ended:
            self._answer(event, ControlResponse.FAILURE, "the experiment has ended")
        elif control_event is not None:
            number = int(request.subject or 0)
            self._arbitrate(Ask(control_event, name, number), event, now_s, now_ns)
        elif kind <= 0:
            self._answer(event, ControlResponse.CMD_NOT_SUPPORTED, f"there is no request with the number {kind}")
        elif kind == _ACTION_SUPPORT or (kind == _PARAM and _is_get(request)):
            self._arbitrate(Ask(Event.READ, name), event, now_s, now_ns)
        else:
            self._arbitrate(Ask(Event.COMMAND, name), event, now_s, now_ns)

    def _hear(self, event: RequestIn, now_s: float) -> Hearing:
        """Whether the peer may speak for the name that it gives; if not, it is told so."""
        name = event.name
        if not name:
            why = "say who you are: set the socket's identity to the component's name"
        elif event.user is not None and event.user != name:
            why = f"the key is that of {event.user}, not of {name}"
        else:
            hearing = self._sessions.hear(event.connection, name, event.request.id, now_s)
            if hearing is not Hearing.TAKEN:
                return hearing
            why = f"another component is connected as {name}; each needs a name of its own"
        if event.connection not in self._told:
            self._told.add(event.connection)
            self._log("WARNING", f"refused a request of {name or 'a nameless peer'}: {why}")
        response = Response(int(ControlResponse.FAILURE), b"", why, event.request.id)
        self._effects.append(Reply(event.connection, name, response))
        return Hearing.TAKEN

    def _repeated(self, event: RequestIn, outcome: Fate | Response, now_s: float) -> bool:
        """A request comes again with its id: answer it without doing it again. False: it may be done."""
        name, request = event.name, event.request
        if isinstance(outcome, Response):
            self._effects.append(Reply(event.connection, name, outcome))
            return True
        if outcome is Fate.PENDING:
            return True  # its answer will go to the newest connection
        if self._forwarder.ask_again(name, request.id, now_s):
            self._once.note(name, request, Fate.PENDING)
            return True
        # A translator that knows ids answers what became of it. Setting something twice does no harm either; an
        # action does, so what nobody knows stays unknown.
        may_send = self._ids_known or request.kind != _ACTION
        if may_send and (self._control.holder == name or _reads(request)):
            return False
        reason = f"{UNKNOWN}it was sent once, and is not sent again"
        response = Response(int(ControlResponse.NO_RESPONSE), b"", reason, request.id)
        self._effects.append(Reply(event.connection, name, response))
        return True

    def _answer(self, event: RequestIn, code: ControlResponse, reason: str = "") -> None:
        response = Response(int(code), b"", reason, event.request.id)
        self._once.note(event.name, event.request, response)
        self._effects.append(Reply(event.connection, event.name, response))

    # --- control ---

    def _arbitrate(self, ask: Ask, event: RequestIn | None, now_s: float, now_ns: int) -> None:
        """Apply the table; `event` is the request to be answered, if somebody asked."""
        before = self._control
        row = arbitration.row_for(before, ask, self._rules)
        if Do.FORWARD in row.do:
            assert event is not None
            self._forward(event, now_s, now_ns, command=ask.event is Event.COMMAND)
            return
        self._control = after = arbitration.apply(row, before, ask)
        if after != before:
            self._control_changed(before, ask, row, now_s, now_ns)
        if event is not None and row.response is not None:
            self._answer(event, row.response, arbitration.reason(row, before, ask, self._rules))
        if after.ended and not before.ended:
            self._effects.append(Kill())

    def _control_changed(self, before: Control, ask: Ask, row: arbitration.Row, now_s: float, now_ns: int) -> None:
        """Save, act and tell, in this order, before whoever asked is answered."""
        after = self._control
        self._lease.held_by(after.holder, now_ns)
        wanted: list[str] = []
        if row.cause is not None and (before.holder is not None or row.cause is Cause.MANUAL):
            wanted = self._watchdog.control_taken(row.cause, self._action_in_flight())
        publish = self._stamp_control(now_ns) if after.published() != before.published() else None
        self._effects.append(SaveState(self.snapshot()))
        self._log("INFO", _said(before, after, ask, row, self._rules))
        for action in wanted:
            self._log("WARNING", f"{action} is sent to the microscope, since {row.cause.value if row.cause else ''}")
        if before.holder is not None and after.holder is None:
            self._call_back(before.holder, row.cause)
        self._send_own(now_s)
        if publish is not None:
            self._effects.append(publish)

    def _call_back(self, former: str, cause: Cause | None) -> None:
        """Commands of a former holder that have not been sent are not sent any more."""
        for job in self._forwarder.call_back(lambda job: job.command and job.client == former):
            reason = f"control was taken before this was sent: {cause.value if cause else ''}"
            self._finish(job, Response(int(ControlResponse.NOT_IN_CONTROL), b"", reason, job.request.id))

    def _action_in_flight(self) -> str | None:
        flight = self._forwarder.flight
        return str(flight.request.subject) if flight is not None and flight.request.kind == _ACTION else None

    def _publish_control(self, now_ns: int) -> None:
        publish = self._stamp_control(now_ns)
        self._effects += [SaveState(self.snapshot()), publish]

    def _stamp_control(self, now_ns: int) -> Publish:
        """The control state as a packet, which has its time before it is published: that is saved first."""
        self._announce_at_s = None
        payload = self._codec.encode_control_state(self._control.published())
        packet, cached = self._cache.stamp(CONTROL_STATE, payload, now_ns)
        return Publish(packet, None, cached)

    def _holder_dead_at_s(self) -> float | None:
        """When the holder is given up, if it does not come back; None if it is there, or nobody is in control."""
        holder = self._control.holder
        if holder is None or self._sessions.connection_of(holder) is not None:
            return None
        lost_s = self._sessions.lost_since_s(holder)
        if lost_s is None:
            return self._started_s + self._settings.restart_grace_s
        return lost_s + self._settings.grace_s

    # --- the translator ---

    def _forward(self, event: RequestIn, now_s: float, now_ns: int, *, command: bool) -> None:
        name, request = event.name, event.request
        if command:
            if self._watchdog.wants_retract and self._forwarder.up:
                self._answer(event, ControlResponse.NOT_FREE, "the tip is being retracted, since a holder died")
                return
            refusal = self._guard.check(name, request, now_ns)
            if refusal is not None:
                self._log("WARNING", f"refused {name}: {refusal.reason}")
                self._once.note(name, request, refusal)
                self._effects.append(Reply(event.connection, name, refusal))
                return
            self._lease.used(now_ns)
        job = Job(name, request, command, connection=event.connection, states_seen=self._watchdog.states_seen)
        refused = self._forwarder.ask(job, now_s)
        if refused is not None:
            self._effects.append(Reply(event.connection, name, refused.response))
        elif request.id:
            self._once.note(name, request, Fate.PENDING)
            if request.kind == _ACTION and not self._ids_known:
                self._sent.append((name, request.id, fingerprint(request)))
                self._effects.append(SaveState(self.snapshot()))

    def _on_reply(self, event: TranslatorReply, now_s: float, now_ns: int) -> None:
        settled = self._forwarder.answered(event.number, event.response, now_s)
        if settled is not None:
            self._settle(settled, now_s, now_ns)

    def _settle(self, settled: Settled, now_s: float, now_ns: int) -> None:
        """A request has come to its end."""
        job, end, response = settled.job, settled.end, settled.response
        if end is End.ANSWERED or end is End.LATE:
            if job.request.id:
                self._ids_known = response.id == job.request.id
            response.id = job.request.id
            if response.code == _SUCCESS and job.command:
                self._learn(job, response, now_ns)
        if not job.client:
            self._own_ended(job, end, response, now_s)
        elif end is End.ANSWERED:
            self._finish(job, response)
        elif end is End.LATE:
            self._once.note(job.client, job.request, response)
            self._log("WARNING", f"the translator answered {job.client} late; asked again, it gets that answer")
        elif end is End.UNKNOWN:
            self._finish(job, response, Fate.UNKNOWN)
        else:
            self._once.forget(job.client, job.request)
            self._reply_to(job, response)

    def _finish(self, job: Job, response: Response, fate: Fate | None = None) -> None:
        self._once.note(job.client, job.request, response if fate is None else fate)
        self._reply_to(job, response)

    def _reply_to(self, job: Job, response: Response) -> None:
        """Answer over the newest connection of the client; without an id only over the one that it asked by."""
        connection = self._sessions.connection_of(job.client)
        if connection is not None and (job.request.id or connection == job.connection):
            self._effects.append(Reply(connection, job.client, response))

    def _learn(self, job: Job, response: Response, now_ns: int) -> None:
        """What a command that succeeded changed."""
        request = job.request
        told = self._codec.decode_parameter(response.payload) if request.kind == _PARAM and response.payload else None
        self._guard.carried_out(request, now_ns, told)
        if request.kind == _ACTION:
            self._watchdog.started(str(request.subject), job.states_seen)
        if job.client == self._control.holder:
            self._lease.used(now_ns)

    def _on_translator_up(self, event: TranslatorUp, now_s: float, now_ns: int) -> None:
        for settled in self._forwarder.connected():
            self._settle(settled, now_s, now_ns)
        # does it retract, and does it know ids (ours do, those of version 1 do not)
        action = self._settings.watchdog.retract or names.STOP_SCAN
        request = Request(_ACTION_SUPPORT, action, self._codec.encode_action(action), _PROBE_ID)
        self._probe = self._forwarder.ask_own(request, now_s)
        self._send_own(now_s)

    def _on_translator_down(self, event: TranslatorDown, now_s: float, now_ns: int) -> None:
        for settled in self._forwarder.lost():
            self._settle(settled, now_s, now_ns)

    def _on_translator_caught_up(self, event: TranslatorCaughtUp, now_s: float, now_ns: int) -> None:
        if self._announce_at_s is not None:
            self._publish_control(now_ns)

    def _send_own(self, now_s: float) -> None:
        while (action := self._watchdog.next_action()) is not None:
            request = Request(_ACTION, action, self._codec.encode_action(action))
            if self._forwarder.ask_own(request, now_s) is None:
                self._watchdog.unsent()
                return

    def _own_ended(self, job: Job, end: End, response: Response, now_s: float) -> None:
        if end is End.LATE:
            return
        if job is self._probe:
            if response.code == ControlResponse.ACTION_NOT_SUPPORTED:
                self._watchdog.cannot(str(job.request.subject))
            return
        if not self._forwarder.up:
            self._watchdog.unsent()
            return
        result = self._watchdog.answered(response.code)
        if result is Result.FAILED:
            self._log("ERROR", f"the microscope does not {job.request.subject}: {response.reason or response.code}")
        elif result is Result.DONE:
            self._log("INFO", f"{job.request.subject}: done")
        if result is not Result.AGAIN:
            self._effects.append(SaveState(self.snapshot()))
        self._send_own(now_s)

    def _on_packet(self, event: PacketIn, now_s: float, now_ns: int) -> None:
        message = event.header.message
        if message == CONTROL_STATE:
            self._tell_once("WARNING", "the translator publishes a ControlState, which is the scheduler's: dropped")
            return
        source_ns = event.packet.time_ns
        taken = self._take(event.packet, event.header, now_ns)
        if taken is None:
            return
        self._effects.append(Publish(taken[0], source_ns, taken[1]))
        if message in _TELLING:
            self._on_telling(self._codec.decode_packet(message, event.packet.payload), now_s, now_ns)

    def _take(self, packet: Packet, header: PacketHeader, now_ns: int) -> tuple[Packet, bool] | None:
        try:
            return self._cache.take(packet, header, now_ns)
        except AfspmError as error:
            self._tell_once("ERROR", f"{header.message} is not published: {error}")
            return None

    def _on_telling(self, told: object, now_s: float, now_ns: int) -> None:
        if isinstance(told, ScopeStatus):
            self._watchdog.scope_is(told.state)
            self._lease.scope_is(told.state, now_ns)
            self._send_own(now_s)
        elif isinstance(told, Feedback):
            self._watchdog.feedback_is(told)
        if isinstance(told, Feedback | ScanParameters | ProbePosition):
            self._guard.published(told, now_ns)

    # --- time ---

    def _on_tick(self, event: Tick, now_s: float, now_ns: int) -> None:
        if self._announce_at_s is not None and now_s >= self._announce_at_s:
            self._publish_control(now_ns)
        dead_at_s, holder = self._holder_dead_at_s(), self._control.holder
        if holder is not None and dead_at_s is not None and now_s >= dead_at_s:
            self._arbitrate(Ask(Event.DEAD, holder), None, now_s, now_ns)
        lease_ns, holder = self._lease.deadline_ns(), self._control.holder
        if holder is not None and lease_ns is not None and now_ns >= lease_ns:
            self._arbitrate(Ask(Event.IDLE, holder), None, now_s, now_ns)
        for settled in self._forwarder.expire(now_s):
            self._settle(settled, now_s, now_ns)

    # --- telling people ---

    def _log(self, level: str, text: str) -> None:
        self._effects.append(Log(level, text))

    def _tell_once(self, level: str, text: str) -> None:
        if text not in self._told and len(self._told) < 1000:
            self._told.add(text)
            self._log(level, text)


def _is_get(request: Request) -> bool:
    return isinstance(request.subject, Parameter) and request.subject.value is None


def _reads(request: Request) -> bool:
    return request.kind == _ACTION_SUPPORT or (request.kind == _PARAM and _is_get(request))


def _said(before: Control, after: Control, ask: Ask, row: arbitration.Row, rules: Rules) -> str:
    """A change of control in words, for the log."""
    parts = []
    if after.holder != before.holder and after.holder is not None:
        parts.append(f"{after.holder} is in control")
        if after.solving:
            parts.append(f"to solve {rules.problems.name(after.solving)}")
    for number in sorted(after.problems.keys() ^ before.problems.keys()):
        done = "flagged" if number in after.problems else "cleared"
        parts.append(f"{rules.problems.name(number)} is {done} by {ask.who};")
    if after.mode is not before.mode:
        parts.append(f"the mode is {after.mode.name} by {ask.who};")
    if after.ended and not before.ended:
        parts.append(f"the experiment is ended by {ask.who};")
    if before.holder is not None and after.holder is None and row.cause is not None:
        parts.append(f"{before.holder} is no longer in control: {row.cause.value}")
    return " ".join(parts).rstrip(";") or f"{ask.who} {ask.event.value}"
