"""Sockets and disk around the scheduler's decisions: messages become inputs, and effects are carried out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Hashable, Iterable
from typing import TYPE_CHECKING, Protocol

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import (
    HAS_ENDED,
    RELAY_REQUEST,
    ControlRequest,
    ControlResponse,
    LoggedPacket,
    Packet,
    Response,
    ResponseDetail,
)
from afspm.scheduler import events
from afspm.transport.polling import milliseconds
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.router import PeerAsked, PeerConnected, RouterEvent
from afspm.transport.scheduler_sockets import LinkReply, LinkUp

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.scheduler.saved_state import SavedState
    from afspm.scheduler.scheduler_core import SchedulerCore
    from afspm.scheduler.write_ahead import WriteAhead
    from afspm.transport.rate_limited_log import RateLimitedLog
    from afspm.transport.scheduler_sockets import SchedulerSockets, Source

_LEVELS = logging.getLevelNamesMapping()
_LATE_S = 0.005
"""Tolerated lateness of a deadline while messages arrive.

Computing the next deadline after each message would cost as much as processing some messages.
"""
_TOGETHER_BYTES = 1 << 20
"""Packets are written together up to this size: the first one must not wait long for the others."""
_WRITTEN_DOWN_LATE = (bytes([RELAY_REQUEST]), bytes([ControlRequest.ADD_EXP_PRBLM]))
"""Requests that are still recorded after the end."""


class FrameWorker(Protocol):
    """The worker of a coordinate frame. It has threads or processes of its own, so no call waits.

    Attributes:
        wake: called from any thread when there is a report.
    """

    wake: Callable[[], None]

    def take(self, job: object) -> None:
        """Take the job of a `Delegate` effect."""
        ...

    def reports(self) -> Iterable[object]:
        """Yield the reports since the last call, oldest first; a report is handled before the next is taken."""
        ...

    def close(self) -> None:
        """Stop the worker."""
        ...


class SchedulerShell:
    """A running scheduler: `start`, then `handle` the result of `wait` until it is `over`."""

    def __init__(
        self,
        core: SchedulerCore,
        sockets: SchedulerSockets,
        clock: Clock,
        write_ahead: WriteAhead,
        warnings: RateLimitedLog,
        log: logging.Logger,
        worker: FrameWorker | None = None,
    ) -> None:
        self._core = core
        self._sockets = sockets
        self._clock = clock
        self._write_ahead = write_ahead
        self._warnings = warnings
        self._log = log
        self._replay: tuple[Packet, ...] = ()
        self._next_deadline_s = 0.0  # at the deadlines, in real monotonic time
        self.ended = False
        self._tip_is_safe = True
        self._worker = worker
        if worker is not None:
            worker.wake = sockets.wake_up
        sockets.publisher.history = self._history

    def start(self) -> None:
        self._carry_out(self._core.start(self._clock.monotonic_s(), self._clock.now_ns()))

    def wait(self) -> list[Source]:
        """Wait for a message or a deadline, and return the sources that are ready."""
        next_s = min(self._core.leave_at_s if self.ended else self._next_deadline_s, self._sockets.router.due_s)
        timeout_s = next_s - self._clock.monotonic_s()
        return self._sockets.wait(None if timeout_s == math.inf else milliseconds(timeout_s))

    @property
    def over(self) -> bool:
        """Whether the experiment and the grace period after it have ended."""
        return self.ended and self._clock.monotonic_s() >= self._core.leave_at_s

    def handle(self, ready: list[Source]) -> None:
        """Process the worker's reports and incoming messages, then expired deadlines."""
        if self.ended:
            self._handle_after_end(ready)
            return
        for report in () if self._worker is None else self._worker.reports():
            self._step_with(events.FrameReported(report))
        sockets = self._sockets
        for source in ready:
            if source in (sockets.router, sockets.router.monitor):
                self._receive_requests()
            elif source is sockets.link:
                for heard in sockets.link.receive():
                    self._step_with(events.TranslatorReply(heard.number, _response(heard)))
            elif source is sockets.subscriber:
                self._receive_packets()
            elif source is sockets.publisher:
                sockets.publisher.serve()
            elif source is sockets.subscriber.monitor:
                sockets.subscriber.follow()
            else:
                for change in sockets.link.follow():
                    self._step_with(events.TranslatorUp() if isinstance(change, LinkUp) else events.TranslatorDown())
        now_s = self._clock.monotonic_s()
        if now_s >= sockets.router.due_s:
            self._receive_requests()
        if now_s >= self._next_deadline_s:
            self._deadlines(now_s)
        elif now_s + _LATE_S < self._next_deadline_s:
            self._next_deadline_s = now_s + _LATE_S  # the messages may have set an earlier deadline

    def _handle_after_end(self, ready: list[Source]) -> None:
        # after the end no request is decided: each is answered that the experiment has ended
        sockets = self._sockets
        for source in ready:
            if source is sockets.publisher:
                # a subscriber that joins now has missed the signal
                if sockets.publisher.serve():
                    sockets.publisher.kill()
            elif source in (sockets.router, sockets.router.monitor):
                self._receive_requests()
            elif source is sockets.link:
                sockets.link.receive()
            elif source is sockets.link.monitor:
                if any(isinstance(change, LinkUp) for change in sockets.link.follow()):
                    self._close_translator()
            elif source is sockets.subscriber:
                sockets.subscriber.receive()
            else:
                sockets.subscriber.follow()
        if self._clock.monotonic_s() >= sockets.router.due_s:
            self._receive_requests()

    def _close_translator(self) -> None:
        # a translator subscribes to nothing, so CLOSE is sent to it. With a tip in danger it gets none: it retracts the
        # tip by itself when it is stopped or its parent has gone
        if self._tip_is_safe:
            self._sockets.link.send(0, [wire.CLOSE])

    def _request_after_end(self, asked: RouterEvent) -> None:
        # final process states, and problems seen after the end, still belong in the record
        if not isinstance(asked, PeerAsked) or not asked.frames:
            return
        if asked.frames[0] in _WRITTEN_DOWN_LATE:
            self._request(asked)
            return
        ended = ResponseDetail.EXPERIMENT_ENDED
        self._answer(asked, Response(ControlResponse.FAILURE, b"", HAS_ENDED, wire.id_of(asked.frames), ended))

    def stop(self) -> None:
        """Save the duty towards a tip in danger for a resumed run, unless the experiment has ended."""
        if not self.ended:
            self._step_with(events.Stopped())

    def close(self) -> None:
        """Stop the frame's worker, and flush the files."""
        if self._worker is not None:
            self._worker.close()
        self._write_ahead.close()

    # --- inputs ---

    def _step_with(self, event: events.Input) -> None:
        self._carry_out(self._decide(event))

    def _decide(self, event: events.Input) -> list[events.Effect]:
        return self._core.step(event, self._clock.monotonic_s(), self._clock.now_ns())

    def _receive_requests(self) -> None:
        for event in self._sockets.router.receive():
            if self.ended:
                self._request_after_end(event)
            elif isinstance(event, PeerAsked):
                self._request(event)
            elif isinstance(event, PeerConnected):
                self._step_with(events.Connected(event.connection))
            else:
                self._step_with(events.Disconnected(event.connection))

    def _request(self, asked: PeerAsked) -> None:
        name = asked.name
        if not asked.frames:
            self._step_with(events.Greeted(asked.connection, name, asked.user))
            return
        try:
            request = wire.decode_request(asked.frames)
        except WireError as error:
            self._warnings.warning(f"refused a request of {name or 'a nameless peer'}: {error}")
            response = Response(error.response, reason=str(error), id=wire.id_of(asked.frames))
            self._answer(asked, response)
            self._step_with(events.Unreadable(name, response))
            return
        now_s = self._clock.monotonic_s()
        event = events.RequestIn(asked.connection, name, request, asked.user, now_s)
        self._carry_out(self._core.step(event, now_s, self._clock.now_ns()))

    def _answer(self, asked: PeerAsked, response: Response) -> None:
        self._reply(events.Reply(asked.connection, asked.name, response))

    def _receive_packets(self) -> None:
        # small packets go to the disk's thread together: handing one over and waiting takes as long as receiving and
        # publishing it
        effects, size = list[events.Effect](), 0
        for incoming in self._sockets.subscriber.receive():
            if isinstance(incoming, CaughtUp):
                effects += self._decide(events.TranslatorCaughtUp())
            if not isinstance(incoming, PacketReceived):
                continue
            packet = incoming.packet
            try:
                header = wire.header(packet.envelope, packet.payload)
            except WireError as error:
                self._warnings.warning(f"dropped a packet of the translator: {error}")
                continue
            effects += self._decide(events.PacketIn(packet, header))
            size += len(packet.payload)
            if size >= _TOGETHER_BYTES:
                self._carry_out(effects)
                effects, size = [], 0
        self._carry_out(effects)

    def _history(self, subscriber: Hashable, prefixes: tuple[str, ...], since_ns: int) -> Iterable[Packet]:
        self._replay = ()
        self._step_with(events.ReplayRequested(subscriber, prefixes, since_ns))
        return self._replay

    def _deadlines(self, now_s: float) -> None:
        if self._core_due_s() <= now_s:
            self._step_with(events.Tick())
        self._next_deadline_s = self._core_due_s()

    def _core_due_s(self) -> float:
        due_s = self._core.deadline_s()
        if (deadline_ns := self._core.deadline_ns()) is not None:
            wait_s = self._clock.real_s((deadline_ns - self._clock.now_ns()) * 1e-9)
            due_s = min(math.inf if due_s is None else due_s, self._clock.monotonic_s() + wait_s)
        return math.inf if due_s is None else due_s

    # --- effects ---

    def _carry_out(self, effects: Iterable[events.Effect]) -> None:
        sockets = self._sockets
        effects = [*effects]
        # first: a kill between two effects must leave nothing published that a restart does not know
        self._persist(effects)
        for effect in effects:
            match effect:
                case events.Reply():
                    self._reply(effect)
                case events.Forward():
                    sockets.link.send(effect.number, wire.encode_request(effect.request))
                case events.Publish():
                    sockets.publisher.publish(effect.packet)
                case events.Replay():
                    self._replay = effect.packets
                case events.Log():
                    self._log.log(_LEVELS.get(effect.level, logging.INFO), "%s", effect.text)
                case events.Delegate():
                    assert self._worker is not None, "a frame with jobs has a worker"
                    self._worker.take(effect.job)
                case events.Kill():
                    sockets.publisher.serve()  # a subscriber that connects at this moment gets the end, too
                    sockets.publisher.kill()
                    self._tip_is_safe = effect.tip_is_safe
                    self._close_translator()
                    self.ended = True

    def _reply(self, reply: events.Reply) -> None:
        self._sockets.router.reply(reply.connection, wire.encode_response(reply.response))

    def _persist(self, effects: list[events.Effect]) -> None:
        entries: list[LoggedPacket] = []
        state: SavedState | None = None
        over = self.ended
        for effect in effects:
            if isinstance(effect, events.SaveState):
                state = effect.state
            elif isinstance(effect, events.Publish):
                # packets after the end are recorded, but not cached: a resumed run must not replay its end
                entries.append(LoggedPacket(effect.packet, effect.source_ns, 0 if over else effect.history))
            elif isinstance(effect, events.Kill):
                over = True
        self._write_ahead.write(state, entries)


def _response(reply: LinkReply) -> Response:
    try:
        return wire.decode_response(reply.frames)
    except WireError as error:
        return Response(int(ControlResponse.FAILURE), reason=f"the translator's answer can't be read: {error}")
