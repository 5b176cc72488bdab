"""Requests, from being heard to being answered: nothing is done twice, and everybody gets an answer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

from afspm.logic.arbitration import ArbitrationState, Cause
from afspm.logic.coordinate_frame import CoordinateFrame, MappedRequest
from afspm.logic.event_log import SCHEDULER, EventLog
from afspm.logic.events import Codec, Effect, Log, Reply, RequestIn, SaveState
from afspm.logic.forwarder import ForwardedRequest, Forwarder, ForwardOutcome, SettledRequest
from afspm.logic.idempotency_cache import IdempotencyCache, RequestStatus, fingerprint
from afspm.logic.lease import Lease
from afspm.logic.limit_checker import LimitChecker, is_get
from afspm.logic.pre_positioner import PrePositioner
from afspm.logic.safety_commands import SafetyCommands
from afspm.logic.sessions import Hearing, SessionTable, run_of
from afspm.logic.settings import SchedulerSettings
from afspm.logic.watchdog import Watchdog, feedback_of
from afspm.model import (
    OTHER_RUN_RESPONSE,
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    component_of,
)

_ACTION, _PARAM = int(ControlRequest.ACTION), int(ControlRequest.PARAM)
_ACTION_SUPPORT, _SUCCESS = int(ControlRequest.ACTION_SUPPORT), int(ControlResponse.SUCCESS)
_SENT_REMEMBERED = 100
_UNCLEAR_S = 0.5  # real; the closing of a connection is seen within milliseconds
OwnEnd = Callable[[Response, float, int], Iterable[Effect]]
"""Told of the answer to a request of the scheduler's own, with now_s and now_ns; what follows from it."""
LATE = "late: it had been told that there was no answer"
"""Of an answer of the translator that came after all."""
_ANOTHER_RUN = "this scheduler is that of another run: two experiments have the same address"
_TWO_OF_A_NAME = "another component is connected as {name}; each needs a name of its own"


@dataclass(frozen=True, eq=False)
class _Reading:
    """A request that waits for the values its limits depend on.

    Attributes:
        names: of those that are still to come.
        deadline_s: when (real) it must be answered.
    """

    event: RequestIn
    names: set[str]
    deadline_s: float


class RequestPipeline:
    """Takes requests in, passes them on to the translator, and answers them.

    Attributes:
        effects: what is to be done is appended here; the owner gives a new list for every step.
        ids_known: whether the translator knows the ids of requests; None: that is not known.

    Args:
        control: says who is in control.
        save: says what is to be saved.
        chronicle: is told of every request that has got its answer.
        frame: the coordinates of components, where they are not those of the microscope.
    """

    def __init__(
        self,
        settings: SchedulerSettings,
        codec: Codec,
        watchdog: Watchdog,
        lease: Lease,
        control: Callable[[], ArbitrationState],
        save: Callable[[], SaveState],
        chronicle: EventLog,
        frame: CoordinateFrame | None = None,
    ) -> None:
        self.effects: list[Effect] = []
        self._run = settings.run
        self.sessions = SessionTable(settings.takeover_s)
        self.forwarder = Forwarder(settings.request_timeout_s, settings.patience_s, settings.longest_queue)
        self.guard = LimitChecker(settings.limits)
        self.errands = SafetyCommands(self.forwarder, watchdog, codec)
        self.mover = PrePositioner(watchdog)
        self._once = IdempotencyCache()
        self._codec = codec
        self._watchdog = watchdog
        self._lease = lease
        self._control = control
        self._save = save
        self._event_log = chronicle
        self._frame = frame
        self._asked_by_us: dict[int, OwnEnd] = {}
        self._reading: list[_Reading] = []
        self.ids_known: bool | None = None
        # actions that only we know of: a translator of version 1 would do them again, one of ours not, but for one that
        # was done already it must not be moved
        self._sent: deque[tuple[str, str, int]] = deque(maxlen=_SENT_REMEMBERED)
        self._refused: set[int] = set()
        self._unclear: dict[str, tuple[RequestIn, float]] = {}  # by name, and until when it is not answered

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, as plain JSON."""
        return {"sent": list(self._sent), "sessions": self.sessions.tokens(), "guard": self.guard.snapshot()}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self.sessions.restore(state["sessions"])
        if "guard" in state:  # not in what a scheduler wrote that was older
            self.guard.restore(state["guard"])
        for client, request_id, print_ in state["sent"]:
            self._sent.append((client, request_id, print_))
            self._once.restore(client, request_id, print_, RequestStatus.UNKNOWN)

    def disconnected(self, connection: int, now_s: float) -> str | None:
        """A connection is gone; returns the name that lost its connection by that."""
        self._refused.discard(connection)
        return self.sessions.disconnected(connection, now_s)

    def clear_up(self, name: str) -> RequestIn | None:
        """The request of the peer that waited until the one connected as `name` before it has closed."""
        waiting = self._unclear.pop(name, None)
        return waiting[0] if waiting is not None else None

    def unclear_until_s(self) -> float | None:
        """When the first of them has waited long enough; None: nobody waits."""
        return min((until_s for _, until_s in self._unclear.values()), default=None)

    def refuse_unclear(self, now_s: float) -> None:
        """Both connections go on: they are two."""
        for name, (event, until_s) in list(self._unclear.items()):
            if now_s >= until_s:
                del self._unclear[name]
                self._refuse(event, _TWO_OF_A_NAME.format(name=name))

    def take(self, event: RequestIn, now_s: float) -> bool:
        """Hear a request. True: it is new and to be decided; False: it is seen to."""
        if not self._hear(event, now_s):
            return False
        outcome = self._once.look_up(event.name, event.request) if event.request.id else None
        return outcome is None or not self._repeated(event, outcome, now_s)

    def _hear(self, event: RequestIn, now_s: float) -> bool:
        """Whether the peer may speak for the name that it gives; if not, it is told so."""
        name = event.name
        if not name:
            self._refuse(event, "say who you are: set the socket's identity to the component's name")
            return False
        if event.user is not None and event.user != component_of(name):
            self._refuse(event, f"the key is that of {event.user}, not of {name}")
            return False
        if self._run and (run := run_of(name, event.request.id)) and run != self._run:
            self._refuse(event, _ANOTHER_RUN, OTHER_RUN_RESPONSE)
            return False
        hearing = self.sessions.hear(event.connection, name, event.request.id, now_s)
        if hearing is Hearing.UNCLEAR and name not in self._unclear and event.connection not in self._refused:
            self._unclear[name] = (event, now_s + _UNCLEAR_S)
        elif hearing in (Hearing.TAKEN, Hearing.UNCLEAR):
            self._refuse(event, _TWO_OF_A_NAME.format(name=name))
        return hearing is Hearing.ACCEPTED

    def _refuse(self, event: RequestIn, why: str, code: int = ControlResponse.FAILURE) -> None:
        if event.connection not in self._refused:
            self._refused.add(event.connection)
            self._log("WARNING", f"refused a request of {event.name or 'a nameless peer'}: {why}")
        self._tell(event, Response(int(code), b"", why, event.request.id), tells_why=True)

    def _repeated(self, event: RequestIn, outcome: RequestStatus | Response, now_s: float) -> bool:
        """A request comes again with its id: answer it without doing it again. False: it may be done."""
        name, request = event.name, event.request
        if isinstance(outcome, Response):
            self.effects.append(Reply(event.connection, name, outcome, request.kind))
            return True
        if outcome is RequestStatus.PENDING:
            return True  # its answer will go to the newest connection
        if self.forwarder.ask_again(name, request.id, now_s):
            self._once.note(name, request, RequestStatus.PENDING)
            return True
        # A translator that knows ids answers what became of it. Setting something twice does no harm either; an
        # action does, so what nobody knows stays unknown.
        may_send = self.ids_known or request.kind != _ACTION
        if may_send and (self._control().holder == name or reads(request)):
            return False
        reason = "outcome unknown: it was sent once, and is not sent again"
        unknown = ResponseDetail.OUTCOME_UNKNOWN
        self._tell(event, Response(int(ControlResponse.NO_RESPONSE), b"", reason, request.id, unknown))
        return True

    def answer(
        self,
        event: RequestIn,
        code: ControlResponse,
        reason: str = "",
        payload: bytes = b"",
        detail: ResponseDetail = ResponseDetail.NONE,
    ) -> None:
        """Answer a request by ourselves, once and for all."""
        response = Response(int(code), payload, reason, event.request.id, detail)
        self._once.note(event.name, event.request, response)
        self._tell(event, response)

    def _tell(self, event: RequestIn, response: Response, *, tells_why: bool = False) -> None:
        kind = event.request.kind
        self.effects.append(Reply(event.connection, event.name, response, kind, tells_why=tells_why))
        self._event_log.answered(event.name, event.request, response, event.heard_s)

    def call_back(self, former: str | None, cause: Cause | None) -> None:
        """Commands of a former holder, or of anybody, that have not been sent are not sent any more."""
        reason = f"control was taken before this was sent: {cause.value if cause else 'the mode was changed'}"
        for job in self.forwarder.call_back(lambda job: job.command and former in (None, job.client)):
            self._finish(job, Response(int(ControlResponse.NOT_IN_CONTROL), b"", reason, job.request.id))
        waiting = [reading.event for reading in self._reading if former in (None, reading.event.name)]
        self._reading = [reading for reading in self._reading if reading.event not in waiting]
        if (event := self.mover.call_back(former)) is not None:
            waiting.append(event)
        for event in waiting:
            self.answer_unsent(event, Response(int(ControlResponse.NOT_IN_CONTROL), b"", reason))

    def action_in_flight(self) -> str | None:
        """The action that is with the translator."""
        flight = self.forwarder.flight
        return str(flight.request.subject) if flight is not None and flight.request.kind == _ACTION else None

    def switches_feedback_off(self) -> bool:
        """Whether what is with the translator does."""
        flight = self.forwarder.flight
        feedback = None if flight is None else feedback_of(flight.request)
        return feedback is not None and feedback.on is False

    def forward(self, event: RequestIn, now_s: float, now_ns: int, *, command: bool, deadline_s: float = 0.0) -> None:
        """Pass a request on to the translator, unless a limit, or the watchdog, stands in the way.

        Args:
            deadline_s: of one that has waited for what its limits depend on; 0: it has not.
        """
        name, request = event.name, event.request
        mapped = None
        if self._frame is not None:
            outgoing = self._frame.outgoing(name, request, now_ns)
            if isinstance(outgoing, Response):
                self._refused_by_us(event, outgoing)
                return
            mapped = outgoing
        if command:
            if (why := self._stays_out(self._control())) is not None:
                self.answer(event, ControlResponse.NOT_FREE, why)
                return
            if not deadline_s and self._reads_first(event, now_s, now_ns):
                return
            if self.forwarder.up and not self._is_within_limits(event, mapped, now_ns):
                return  # if not, there is nobody to tell what is in force, as the asker will hear
            self._lease.used(now_ns)
            if request.kind == _ACTION and not self._may_act_here(event, now_s, now_ns):
                return
        self._send(event, mapped, now_s, now_ns, command=command, deadline_s=deadline_s)

    def _reads_first(self, event: RequestIn, now_s: float, now_ns: int) -> bool:
        """Whether the microscope has to be asked for the values that the request's limits depend on; then it is."""
        unread = self.guard.to_be_read(event.request)
        if not unread or not self.forwarder.up:
            return False
        others = [(one.event.name, one.event.request) for one in self._reading]
        for who, request in others + self.forwarder.requests():
            if both := set(unread) & set(self.guard.to_be_read(request)):
                reason = f"{min(both)} is being changed by {who}"
                self._refused_by_us(event, Response(int(ControlResponse.PARAM_ERROR), b"", reason))
                return True
        self._lease.used(now_ns)
        self._once.note(event.name, event.request, RequestStatus.PENDING)
        reading = _Reading(event, set(unread), now_s + self.forwarder.timeout_s)
        self._reading.append(reading)
        for name in unread:
            self._read(name, now_s, partial(self._was_read, reading, name))
        return True

    def _was_read(
        self, reading: _Reading, name: str, response: Response, now_s: float, now_ns: int
    ) -> Iterable[Effect]:
        """One of the values that a request waits for is known now, or can't be."""
        self._forget_unread(name, response, now_s, now_ns)
        reading.names.discard(name)
        if reading not in self._reading:
            return ()  # it was called back
        if response.code == ControlResponse.NO_RESPONSE:
            self._reading.remove(reading)
            self.answer_unsent(reading.event, response)
        elif not reading.names:
            self._reading.remove(reading)
            self.forward(reading.event, now_s, now_ns, command=True, deadline_s=reading.deadline_s)
        return ()

    def read_ahead(self, now_s: float) -> None:
        """Ask for the values of which it counts for how long they hold."""
        for name in self.guard.to_be_known():
            self._read(name, now_s, partial(self._forget_unread, name))

    def _read(self, name: str, now_s: float, ended: OwnEnd) -> None:
        parameter = Parameter(name)
        self.ask_own(Request(_PARAM, parameter, self._codec.encode(parameter)), now_s, ended)

    def _forget_unread(self, name: str, response: Response, now_s: float, now_ns: int) -> Iterable[Effect]:
        """Of a value that can't be read it is not known what it is now."""
        if response.code != _SUCCESS:
            self.guard.forget(name)
        return ()

    def _stays_out(self, control: ArbitrationState) -> str | None:
        """Why nobody commands, since the tip was left in danger; None: whoever is in control may."""
        if not (self._watchdog.owes_retract and self.forwarder.up):
            if not self._watchdog.left_to_people or control.sees_to_tip:
                return None
            return "the tip was in danger; a person brings it back to the surface, then clears device-malfunction"
        if not self._watchdog.put_off:
            return "the tip is being retracted, as it was left in danger"
        if control.sees_to_tip:
            return None
        return "the tip was left in danger and is not retracted yet; only who solves device-malfunction may see to it"

    def _is_within_limits(self, event: RequestIn, mapped: MappedRequest | None, now_ns: int) -> bool:
        """What goes to the microscope is within the limits; if not, the asker is told."""
        if mapped is None:
            refusal = self.guard.check(event.name, event.request, now_ns)
        else:
            refusal = self.guard.check(event.name, mapped.request, now_ns, mapped.names)
            if refusal is not None:
                refusal.reason = f"{refusal.reason}; {mapped.said}"
        if refusal is None:
            return True
        self._refused_by_us(event, refusal)
        return False

    def _may_act_here(self, event: RequestIn, now_s: float, now_ns: int) -> bool:
        """Whether an action may be sent at once: if not, it is answered, or waits for a move."""
        if self._frame is not None and self._moves_first(event, now_s, now_ns):
            return False
        refusal = self.guard.check_place(event.request)
        if refusal is not None:
            self._refused_by_us(event, refusal)
        return refusal is None

    def _refused_by_us(self, event: RequestIn, refusal: Response) -> None:
        self._log("WARNING", f"refused {event.name}: {refusal.reason}")
        self.answer_unsent(event, refusal)

    def _moves_first(self, event: RequestIn, now_s: float, now_ns: int) -> bool:
        """Whether the microscope has to be moved before an action; then it is, or the action is answered."""
        assert self._frame is not None
        move = self._frame.move_before(str(event.request.subject), now_ns)
        if move is None or (event.name, event.request.id) in (sent[:2] for sent in self._sent):
            return False
        if self.mover.busy:
            self.answer(event, ControlResponse.NOT_FREE, "the microscope is being moved for another action")
            return True
        if not self._is_within_limits(event, move, now_ns):
            return True
        job = self.forwarder.ask_own(move.request, now_s)
        if job is None:
            return False  # nobody is there to be moved, as the action will be told
        job.mapped = move
        self._asked_by_us[job.number] = lambda response, now_s, now_ns: self._moved(job, response, now_s, now_ns)
        self.mover.begin(event, job)
        self._once.note(event.name, event.request, RequestStatus.PENDING)
        self.effects.append(self._save())  # with where it is sent: what is told of it is then known after a restart
        return True

    def act_when_moved(self, now_s: float, now_ns: int) -> None:
        """Send the action that waited for the microscope to be moved, if it is."""
        if (ready := self.mover.ready(now_s)) is None:
            return
        event, deadline_s = ready
        if (refusal := self.guard.check_place(event.request)) is not None:  # moved by somebody else meanwhile
            self._refused_by_us(event, refusal)
            return
        self._send(event, None, now_s, now_ns, command=True, deadline_s=deadline_s)

    def _send(
        self,
        event: RequestIn,
        mapped: MappedRequest | None,
        now_s: float,
        now_ns: int,
        *,
        command: bool,
        deadline_s: float = 0.0,
    ) -> None:
        name, request = event.name, event.request
        seen = self._watchdog.states_seen
        job = ForwardedRequest(
            name, request, command, 0, deadline_s,
            connection=event.connection, states_seen=seen, mapped=mapped, heard_s=event.heard_s,
        )  # fmt: skip
        refused = self.forwarder.ask(job, now_s)
        if refused is not None:
            self._once.forget(name, request)
            self._tell(event, refused.response)
            return
        sent, used = _as_sent(job)
        is_to_be_saved = command and self.guard.sending(name, sent, now_ns, used)
        if request.id:
            self._once.note(name, request, RequestStatus.PENDING)
            if request.kind == _ACTION and (self._frame is not None or not self.ids_known):
                self._sent.append((name, request.id, fingerprint(request)))
                is_to_be_saved = True
            elif mapped is not None:
                is_to_be_saved = True  # with what it was mapped to: asked again, it is sent the same
        if is_to_be_saved:
            self.effects.append(self._save())

    def ask_own(self, request: Request, now_s: float, ended: OwnEnd) -> bool:
        """Ask the microscope in the scheduler's own name; False: it can't be asked now."""
        job = self.forwarder.ask_own(request, now_s)
        if job is not None:
            self._asked_by_us[job.number] = ended
        return job is not None

    def settle_all(self, settled: Iterable[SettledRequest], now_s: float, now_ns: int) -> None:
        """Requests have come to their ends."""
        for one in settled:
            self.settle(one, now_s, now_ns)

    def settle(self, settled: SettledRequest, now_s: float, now_ns: int) -> None:
        """A request has come to its end: tell, and remember, what became of it."""
        job, end, response = settled.job, settled.end, settled.response
        if end is ForwardOutcome.ANSWERED or end is ForwardOutcome.LATE:
            if job.request.id:
                self.ids_known = response.id == job.request.id
            response.id = job.request.id
            if response.code == _SUCCESS and (job.command or job.request.kind == _PARAM):
                self._learn(job, response, now_ns)
        if not job.client:
            if not reads(job.request):
                self._event_log.answered(SCHEDULER, job.request, response, job.heard_s)
            self._own_ended(job, end, response, now_s, now_ns)
        elif end is ForwardOutcome.ANSWERED and _was_not_sent(response):
            self._forget(job, response)
        elif end is ForwardOutcome.ANSWERED:
            self._see_feedback(job, response)
            self._finish(job, response, _unknown_fate(response))
        elif end is ForwardOutcome.LATE:
            self._see_feedback(job, response)
            fate = _unknown_fate(response)
            self._once.note(job.client, job.request, fate or response)
            self._is_not_done(job, response, fate)
            self._event_log.answered(job.client, job.request, response, job.heard_s, LATE)
            self._log("WARNING", f"the translator answered {job.client} late; asked again, it gets that answer")
        elif end is ForwardOutcome.UNKNOWN:
            if job.request.kind == _ACTION:
                self._watchdog.started(str(job.request.subject), job.states_seen, certain=False)
            self._see_feedback(job, response)
            self._finish(job, response, RequestStatus.UNKNOWN)
        else:
            self._forget(job, response)

    def _see_feedback(self, job: ForwardedRequest, response: Response) -> None:
        """Whether a request has switched the feedback off, which is not known if nobody knows what became of it."""
        feedback = feedback_of(job.request)
        if feedback is None or feedback.on is not False or response.code == _SUCCESS:
            return
        if response.code == ControlResponse.NO_RESPONSE:
            self._watchdog.danger.feedback_may_be_off()
            self.effects.append(self._save())
        else:
            self._watchdog.danger.feedback_was_left()

    def _forget(self, job: ForwardedRequest, response: Response) -> None:
        """Nothing was done: asked again, with the same id too, it is."""
        self._once.forget(job.client, job.request)
        self.guard.not_done(job.client, *_as_sent(job))
        self._sent = deque((s for s in self._sent if s[:2] != (job.client, job.request.id)), _SENT_REMEMBERED)
        self._reply_to(job, response)

    def _finish(self, job: ForwardedRequest, response: Response, fate: RequestStatus | None = None) -> None:
        self._once.note(job.client, job.request, response if fate is None else fate)
        self._is_not_done(job, response, fate)
        self._reply_to(job, response)

    def _is_not_done(self, job: ForwardedRequest, response: Response, fate: RequestStatus | None) -> None:
        """What was refused does not count as used; what nobody knows of does."""
        if fate is None and response.code != _SUCCESS:
            self.guard.not_done(job.client, *_as_sent(job))

    def _reply_to(self, job: ForwardedRequest, response: Response) -> None:
        """Answer over the newest connection of the client; without an id only over the one that it asked by."""
        self._event_log.answered(job.client, job.request, response, job.heard_s)
        connection = self.sessions.connection_of(job.client)
        if connection is not None and (job.request.id or connection == job.connection):
            self.effects.append(Reply(connection, job.client, response, job.request.kind))

    def _learn(self, job: ForwardedRequest, response: Response, now_ns: int) -> None:
        """What a success changed, or told."""
        request = job.request
        told = self._codec.decode_parameter(response.payload) if request.kind == _PARAM and response.payload else None
        sent, used = _as_sent(job)
        if self.guard.carried_out(sent, now_ns, told, used, job.client):
            self.effects.append(self._save())
        if self._frame is not None:
            self._frame.carried_out(sent, told, now_ns)
            if request.kind == _PARAM and (mapped := self._frame.answer(request, told, now_ns)) is not None:
                response.payload = self._codec.encode(mapped)
        if request.kind == _ACTION:
            changed = self._watchdog.started(str(request.subject), job.states_seen)
        elif (feedback := feedback_of(request)) is not None:
            changed = self._watchdog.danger.feedback_is(feedback)
        else:
            changed = False
        if changed:
            self.effects.append(self._save())
        if job.command and job.client == self._control().holder:
            self._lease.used(now_ns)

    def _own_ended(
        self, job: ForwardedRequest, end: ForwardOutcome, response: Response, now_s: float, now_ns: int
    ) -> None:
        """A request of the scheduler's own came to its end."""
        if (ended := self._asked_by_us.pop(job.number, None)) is not None:
            self.effects += ended(response, now_s, now_ns)
            return
        told = self.errands.ended(job, end, response, now_s)
        if told is not None:
            self.effects += [told, self._save()]

    def _moved(self, job: ForwardedRequest, response: Response, now_s: float, now_ns: int) -> Iterable[Effect]:
        """A move before an action was answered."""
        if (event := self.mover.ended(job, response, now_s)) is not None:
            self.answer_unsent(event, response)
        self.act_when_moved(now_s, now_ns)
        return ()

    def answer_unsent(self, event: RequestIn, response: Response) -> None:
        """Answer a request that is not sent; it may have waited, and be asked by another connection by now."""
        answer = Response(response.code, b"", response.reason, event.request.id)
        if response.code == ControlResponse.NO_RESPONSE:
            answer.reason = f"not sent: what had to come before it failed ({response.reason})"
            answer.detail = ResponseDetail.NOT_SENT
            self._once.forget(event.name, event.request)
        else:
            self._once.note(event.name, event.request, answer)
        asked = ForwardedRequest(
            event.name, event.request, command=True, connection=event.connection, heard_s=event.heard_s
        )
        self._reply_to(asked, answer)

    def _log(self, level: str, text: str) -> None:
        self.effects.append(Log(level, text))


def _as_sent(job: ForwardedRequest) -> tuple[Request, Collection[str] | None]:
    """What the microscope is asked, and the parameters that the asker means to set by that; None: all of them."""
    return (job.request, None) if job.mapped is None else (job.mapped.request, job.mapped.names)


def _was_not_sent(response: Response) -> bool:
    """The translator says that it could not reach the controller, and did nothing."""
    return response.code == ControlResponse.NO_RESPONSE and response.detail is ResponseDetail.NOT_SENT


def _unknown_fate(response: Response) -> RequestStatus | None:
    """The controller did not answer its translator: whether it was done is for that one to say, when asked again."""
    return RequestStatus.UNKNOWN if response.code == ControlResponse.NO_RESPONSE else None


def reads(request: Request) -> bool:
    """Whether a request disturbs nothing."""
    return request.kind == _ACTION_SUPPORT or (request.kind == _PARAM and is_get(request))
