"""Handling of requests: obey one scheduler, execute no request twice, and report a lost controller."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import (
    ControlRequest,
    ControlResponse,
    Parameter,
    Request,
    Response,
    ResponseDetail,
    names,
    request_name,
)
from afspm.model.fencing import Epoch, SchedulerFence
from afspm.model.idempotency_cache import TOO_OLD, Floors
from afspm.model.microscope_status import STARTS, feedback_of
from afspm.model.requests import COMPARE_REQUEST
from afspm.model.sessions import number_of, run_of
from afspm.translator.commands import ASIDE, CommandOutcome, Commands
from afspm.translator.connection import Connection
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.hurry import unhurried
from afspm.translator.observer import Observer
from afspm.translator.setting_groups import KeptSettings
from afspm.translator.state import KeptState, TranslatorState
from afspm.translator.temporary_settings import TemporarySettings
from afspm.translator.trace import TRACE
from afspm.transport.port import RequestReceived

Reply = Callable[[Response, int], None]
_CAPACITY = 300  # answers kept for requests that are repeated


class RequestHandler:
    """The handler of requests to one microscope.

    Args:
        fence: decides which scheduler is obeyed.
        is_connected: returns whether an earlier connection still exists.
        reply: sends a response, and logs a refusal at a level.

    Attributes:
        withdraws: True while the tip is being withdrawn on request.
    """

    def __init__(
        self,
        driver: DriverBase,
        connection: Connection,
        observer: Observer,
        state: TranslatorState,
        temporary: TemporarySettings,
        log: logging.Logger,
        *,
        fence: SchedulerFence,
        is_connected: Callable[[bytes], bool],
        reply: Reply,
    ) -> None:
        self._driver = driver
        self._connection = connection
        self._observer = observer
        self._state = state
        self._fence = fence
        self._is_connected = is_connected
        self._reply = reply
        self._outcomes = RequestOutcomes(state.kept, all_or_nothing=driver.memory_is_all)
        self.commands = Commands(
            driver, state.sequence, temporary, observer.panel, self._record_begin, observer.is_set, observer.claims, log
        )
        self._log = log
        self._acting: Request | None = None
        self.withdraws = False
        self._commander = b""
        self._last_refusal = ""

    def refuses(self, arrived: RequestReceived) -> bool:
        """Refuse a request unless its sender is the scheduler in command; return whether it was refused."""
        before, epoch = self._commander, Epoch.decode(arrived.epoch)
        why = self._fence.refusal(epoch, _run_of(arrived.frames), lambda: self._is_connected(before))
        if not why:
            self._commander = arrived.connection if epoch is not None else before
            return False
        last, self._last_refusal = self._last_refusal, why
        # a peer that is not obeyed may repeat its request for hours: its refusal is logged once
        level = logging.DEBUG if last == why else logging.WARNING
        self._reply(Response(ControlResponse.FAILURE, reason=why, id=wire.id_of(arrived.frames)), level)
        return True

    def answer(self, frames: Sequence[bytes]) -> None:
        """Execute and answer a request; a repeated request gets its earlier answer."""
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            refusal = Response(error.response, reason=str(error), id=wire.id_of(frames))
            self._reply(refusal, logging.DEBUG)  # at DEBUG: a stranger can send millions
            return
        known = self._outcomes.outcome(request)
        if known is not None:
            self._reply(known, logging.DEBUG)  # logged with the first answer; a client may repeat it each second
            return
        self.withdraws = is_withdrawal(request)
        try:
            self._carry_out(request)
        except LOST as error:
            if self._connection.is_reached:
                self._connection.lose(error)
            reason, detail = f"the controller can't be reached: {error}", ResponseDetail.OUTCOME_UNKNOWN
            if self._acting is not request:
                reason, detail = f"not sent: {reason}", ResponseDetail.NOT_SENT
            self._finish(request, Response(ControlResponse.NO_RESPONSE, b"", reason, request.id, detail))
        finally:
            self.withdraws = False

    def act(self, action: str) -> Response:
        """Execute an action of the translator itself, and publish its steps."""
        request = Request(ControlRequest.ACTION, action)
        done = self._withdrawn(request) if is_withdrawal(request) else self.commands.do(request)
        self._observer.play(done.steps)
        return done.response

    def _carry_out(self, request: Request) -> None:
        connection, observer = self._connection, self._observer
        # the last look may be old: the microscope must be free now
        if connection.stands and not (_is_read_only(request) or self._is_kept(request)):
            starts = request.kind == ControlRequest.ACTION and request.subject in STARTS
            look = partial(observer.look_before_start, request) if starts else partial(observer.observe, values=False)
            connection.guarded(look)
        if request.subject != names.RETRACT:
            connection.require()
        try:
            done = self._withdrawn(request) if self.withdraws else self.commands.do(request)
        finally:
            TRACE.command("")
        if done.response.ok and (feedback := feedback_of(request)) is not None:
            observer.panel.feedback.is_set(feedback.on)
        if request.kind == ControlRequest.ACTION and done.response.ok and not done.steps:
            # before the answer, so that the peer then knows the settings changed by its action
            connection.guarded(observer.observe)
        self._finish(request, done.response)
        observer.play(done.steps)
        if done.response.ok and (done.steps or done.announce):
            connection.guarded(partial(observer.observe, done.announce))
            if done.response.reason == ASIDE:
                connection.tell_lost()

    def _withdrawn(self, request: Request) -> CommandOutcome:
        # a retract is always possible: a reachable controller suffices, even if its state can't be read
        driver, connection = self._driver, self._connection
        if driver.withdraws_aside:  # a controller that is lost is not connected to first
            try:
                return self.commands.do(request)
            except LOST as error:
                self._log.error("the tip can't be withdrawn over the connection kept for it: %s", error)
        with unhurried():
            connection.reach_for_retract()
            return self.commands.do(request)

    def _is_kept(self, request: Request) -> bool:
        # it goes to the controller with the next action, before which the state is read
        name = request.subject.name if isinstance(request.subject, Parameter) else ""
        return any(type(group) is KeptSettings and name in group.names for group in self._driver.groups)

    def _record_begin(self, request: Request) -> None:
        self._driver.prove()
        self._acting = request
        TRACE.command(f"{request_name(request.kind)} {request.subject}")
        action = self.commands.actions.get(str(request.subject)) if request.kind == ControlRequest.ACTION else None
        self._observer.asked(request, action)
        in_doubt = self._state.feedback.may_switch(request)
        self._outcomes.begin(request)
        # saved before: after a kill a setting may be written again, but an action must not be repeated
        once = bool(request.id) and request.kind == ControlRequest.ACTION
        if (in_doubt or once) and not self._driver.memory_is_all:
            self._state.save()

    def _finish(self, request: Request, response: Response) -> None:
        # saved before the answer is sent: a retry after a kill gets the same answer
        is_unknown = response.code == ControlResponse.NO_RESPONSE and self._acting is request
        if request.kind == ControlRequest.ACTION and request.subject in STARTS and not (response.ok or is_unknown):
            self._observer.claims.is_refused()
        if self._acting is request:
            self._acting = None
            if request.subject == names.RETRACT and response.ok:
                self._state.feedback.retracted()
            # nothing was changed, or a setting may be written again: a lost controller is back soon
            is_lost = response.code == ControlResponse.NO_RESPONSE and request.kind != ControlRequest.ACTION
            if response.code == ControlResponse.PARAM_ERROR or is_lost:
                self._outcomes.forget(request)
            elif response.code == ControlResponse.NO_RESPONSE:
                # a repetition may come when the controller is back: its answer must not say that it can't be reached
                lost = "the controller was lost during this request: it may or may not have been carried out"
                self._outcomes.finish(request, replace(response, reason=f"{lost} ({response.reason})"))
            else:
                self._outcomes.finish(request, response)
            self._state.save()
        # it starts together with this process: `Connection` logs a controller that does not come
        is_starting = response.detail is ResponseDetail.NOT_SENT and not self._connection.ever_stood
        # the scheduler asks each microscope for a retract: "no" is an answer, and no refusal of anything
        is_question = request.kind == ControlRequest.ACTION_SUPPORT
        self._reply(response, logging.DEBUG if is_starting or is_question else logging.INFO)


def _run_of(frames: Sequence[bytes]) -> str:
    # before decoding, so that a stranger costs little: the id of a component's request names its run
    request_id = frames[2].decode("utf-8", "replace") if len(frames) > 2 else ""
    return run_of(request_id.partition("/")[0], request_id)


def is_withdrawal(request: Request) -> bool:
    """Return whether a request is to withdraw the tip."""
    return request.kind == ControlRequest.ACTION and request.subject == names.RETRACT


def _is_read_only(request: Request) -> bool:
    if request.kind == ControlRequest.PARAM:
        return isinstance(request.subject, Parameter) and request.subject.value is None
    return request.kind in (ControlRequest.ACTION_SUPPORT, COMPARE_REQUEST)


class RequestOutcomes:
    """The outcomes of the last requests with an id. See `model.idempotency_cache` for older ids.

    Args:
        kept: the translator's memory, which is saved with every executed request. So an entry is one text, quick to
            write: the fingerprint of the request, then its outcome.
        all_or_nothing: the microscope's own state is saved together with these outcomes: a request without an outcome
            was not done. Otherwise a request that was begun and has no outcome may have been done.
    """

    def __init__(self, kept: KeptState, *, all_or_nothing: bool) -> None:
        self._shelves: tuple[dict[str, str], ...] = kept.setdefault("ledger", {}), kept.setdefault("unnumbered", {})
        self._kept = kept
        kept.setdefault("forgotten", {})
        # begun and without an outcome: the microscope's state is in the same file, so nothing was done
        if all_or_nothing:
            for shelf in self._shelves:
                for request_id in [key for key, entry in shelf.items() if " " not in entry]:
                    del shelf[request_id]

    def outcome(self, request: Request) -> Response | None:
        """Return the earlier answer to a request; None if the request is new.

        The answer is FAILURE if the id belongs to another request, and NO_RESPONSE if the outcome is unknown.
        """
        entry = self._shelf(request.id).get(request.id) if request.id else None
        if entry is None:
            return self._forgotten(request)
        asked, _, outcome = entry.partition(" ")
        if asked != _fingerprint(request):
            reason = "the id of this request was already used for another one"
            return Response(ControlResponse.FAILURE, reason=reason, id=request.id)
        if not outcome:
            reason = "the translator was restarted during this request: it may or may not have been carried out"
            return Response(ControlResponse.NO_RESPONSE, reason=reason, id=request.id)
        code, payload, reason = outcome.split(" ", 2)
        return Response(int(code), base64.b64decode(payload), reason, request.id)

    def begin(self, request: Request) -> None:
        """Record that a request is about to be executed."""
        if not request.id:
            return
        shelf = self._shelf(request.id)
        shelf[request.id] = _fingerprint(request)
        while len(shelf) > _CAPACITY:
            oldest = next(iter(shelf))
            del shelf[oldest]
            self._kept["forgotten"] = dict(self._floors.forgetting("", [oldest]).numbers)

    @property
    def _floors(self) -> Floors:
        return Floors(numbers=self._kept["forgotten"])

    def _forgotten(self, request: Request) -> Response | None:
        if not self._floors.is_below("", request.id):
            return None
        return Response(ControlResponse.NO_RESPONSE, b"", TOO_OLD, request.id, ResponseDetail.OUTCOME_UNKNOWN)

    def _shelf(self, request_id: str) -> dict[str, str]:
        return self._shelves[number_of(request_id) is None]

    def finish(self, request: Request, response: Response) -> None:
        """Record the outcome of a request."""
        if request.id:
            payload = base64.b64encode(response.payload).decode()
            entry = f"{_fingerprint(request)} {int(response.code)} {payload} {response.reason}"
            self._shelf(request.id)[request.id] = entry

    def forget(self, request: Request) -> None:
        """Remove a request that was not executed, so that it may be repeated with the same id."""
        self._shelf(request.id).pop(request.id, None)


def _fingerprint(request: Request) -> str:
    return hashlib.sha256(bytes([request.kind]) + request.payload).hexdigest()[:16]
