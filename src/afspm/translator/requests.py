"""Answers requests: obeys one scheduler, carries out none twice, and says so when the controller is lost."""

from __future__ import annotations

import base64
import hashlib
import logging
from collections.abc import Callable, Sequence
from functools import partial

from afspm import wire
from afspm.basics.errors import WireError
from afspm.basics.plain_data import Plain
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
from afspm.model.sessions import number_of, run_of
from afspm.translator.commands import Commands
from afspm.translator.connection import Connection
from afspm.translator.driver_base import LOST, DriverBase
from afspm.translator.observer import Observer
from afspm.translator.safe_exit import FeedbackWatch
from afspm.translator.state import TranslatorState
from afspm.translator.temporary_settings import TemporarySettings
from afspm.translator.trace import TRACE
from afspm.transport.port import RequestReceived

Reply = Callable[[Response, int], None]
_CAPACITY = 300


class RequestHandler:
    """Answers the requests to one microscope.

    Args:
        fence: decides which scheduler is obeyed.
        is_connected: tells whether a connection that asked before still stands.
        reply: sends a response, and logs a refusal at a level.
    """

    def __init__(
        self,
        driver: DriverBase,
        connection: Connection,
        observer: Observer,
        state: TranslatorState,
        feedback: FeedbackWatch,
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
        self._feedback = feedback
        self._fence = fence
        self._is_connected = is_connected
        self._reply = reply
        self._outcomes = RequestOutcomes(state.kept, all_or_nothing=driver.memory_is_all)
        self.commands = Commands(driver, state.sequence, temporary, self._about_to_act, log)
        self._acting: Request | None = None
        self._commander = b""
        self._last_refusal = ""

    def refuses(self, arrived: RequestReceived) -> bool:
        """Answer a peer that is not obeyed, and return True; False: it is obeyed."""
        before, epoch = self._commander, Epoch.decode(arrived.epoch)
        why = self._fence.refusal(epoch, _run_in(arrived.frames), lambda: self._is_connected(before))
        if not why:
            self._commander = arrived.connection if epoch is not None else before
            return False
        last, self._last_refusal = self._last_refusal, why
        level = logging.DEBUG if last == why else logging.WARNING
        self._reply(Response(ControlResponse.FAILURE, reason=why, id=wire.id_of(arrived.frames)), level)
        return True

    def answer(self, frames: Sequence[bytes]) -> None:
        """Carry a request out, unless that was done before, and answer it."""
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            refusal = Response(error.response, reason=str(error), id=wire.id_of(frames))
            self._reply(refusal, logging.DEBUG)  # a stranger can send millions
            return
        known = self._outcomes.outcome(request)
        if known is not None:
            self._reply(known, logging.INFO)
            return
        try:
            self._carry_out(request)
        except LOST as error:
            if self._connection.is_reached:
                self._connection.lose(error)
            reason, detail = f"the controller can't be reached: {error}", ResponseDetail.OUTCOME_UNKNOWN
            if self._acting is not request:
                reason, detail = f"not sent: {reason}", ResponseDetail.NOT_SENT
            self._finish(request, Response(ControlResponse.NO_RESPONSE, b"", reason, request.id, detail))

    def act(self, action: str) -> Response:
        """Do an action that nobody has asked for."""
        done = self.commands.do(Request(ControlRequest.ACTION, action))
        self._observer.play(done.steps)
        return done.response

    def _carry_out(self, request: Request) -> None:
        connection, observer = self._connection, self._observer
        # whether it is free is decided by what it does now, not at the last look
        if connection.stands and not _only_asks(request):
            connection.guarded(partial(observer.observe, values=False))
        if request.subject == names.RETRACT:
            connection.reach()  # the way out is always open: a controller that is there will do, whatever else it says
        else:
            connection.require()
        try:
            done = self.commands.do(request)
        finally:
            TRACE.command("")
        if request.kind == ControlRequest.ACTION and done.response.ok and not done.steps:
            connection.guarded(observer.observe)  # first, so that the answered peer knows what its action has set
        self._finish(request, done.response)
        observer.play(done.steps)
        if done.response.ok and (done.steps or done.announce):
            connection.guarded(partial(observer.observe, done.announce))

    def _about_to_act(self, request: Request) -> None:
        """Write down that a request is going to be carried out."""
        self._driver.prove()
        self._acting = request
        TRACE.command(f"{request_name(request.kind)} {request.subject}")
        in_doubt = self._feedback.may_switch(request)
        self._outcomes.begin(request)
        # what a kill leaves half set may be set again; an action may not be done again
        once = bool(request.id) and request.kind == ControlRequest.ACTION
        if (in_doubt or once) and not self._driver.memory_is_all:
            self._state.save()

    def _finish(self, request: Request, response: Response) -> None:
        """Write down what came of a request before anybody hears of it, and answer."""
        if self._acting is request:
            self._acting = None
            if request.subject == names.RETRACT and response.ok:
                self._feedback.retracted()
            if response.code == ControlResponse.PARAM_ERROR:
                self._outcomes.forget(request)  # nothing was changed
            else:
                self._outcomes.finish(request, response)
            self._state.save()
        # it starts together with this process: `Connection` logs a controller that does not come
        is_starting = response.detail is ResponseDetail.NOT_SENT and not self._connection.ever_stood
        self._reply(response, logging.DEBUG if is_starting else logging.INFO)


def _run_in(frames: Sequence[bytes]) -> str:
    """Return the run of a component, from the id of its request; empty: it says none."""
    request_id = frames[2].decode("utf-8", "replace") if len(frames) > 2 else ""
    return run_of(request_id.partition("/")[0], request_id)


def _only_asks(request: Request) -> bool:
    if request.kind == ControlRequest.PARAM:
        return isinstance(request.subject, Parameter) and request.subject.value is None
    return request.kind == ControlRequest.ACTION_SUPPORT


class RequestOutcomes:
    """The outcomes of the last requests that had an id. See `model.idempotency_cache` for older ids.

    Args:
        kept: the translator's memory; whoever owns it saves it, with every request. So an entry is a text, which is
            quickly written: what was asked, and once it is known what came of it.
        all_or_nothing: the microscope's own state is saved together with the ledger: what has no outcome here
            was not done. Otherwise a request that was begun and has no outcome may have been done.
    """

    def __init__(self, kept: Plain, *, all_or_nothing: bool) -> None:
        self._shelves: tuple[dict[str, str], ...] = kept.setdefault("ledger", {}), kept.setdefault("unnumbered", {})
        self._kept = kept
        kept.setdefault("forgotten", {})
        if all_or_nothing:
            for shelf in self._shelves:
                for request_id in [key for key, entry in shelf.items() if " " not in entry]:
                    del shelf[request_id]

    def outcome(self, request: Request) -> Response | None:
        """Return how the request was answered before; None if it is new."""
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
        """The request is going to be carried out."""
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
        """The request was carried out, with this outcome."""
        if request.id:
            payload = base64.b64encode(response.payload).decode()
            entry = f"{_fingerprint(request)} {int(response.code)} {payload} {response.reason}"
            self._shelf(request.id)[request.id] = entry

    def forget(self, request: Request) -> None:
        """Nothing of the request was done: it may be asked again."""
        self._shelf(request.id).pop(request.id, None)


def _fingerprint(request: Request) -> str:
    return hashlib.sha256(bytes([request.kind]) + request.payload).hexdigest()[:16]
