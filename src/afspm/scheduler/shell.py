"""Sockets and disk around the scheduler's decisions: messages become inputs, and effects are carried out."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
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
    PacketHeader,
    Request,
    Response,
    ResponseDetail,
)
from afspm.scheduler import events
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected
from afspm.transport.scheduler_sockets import LinkDown, LinkReply, LinkUp

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.scheduler.saved_state import SavedState
    from afspm.scheduler.scheduler_core import SchedulerCore
    from afspm.transport.rate_limited_log import RateLimitedLog
    from afspm.transport.scheduler_sockets import SocketEvent, Source

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


class Messages(Protocol):
    """The encoding of requests, answers and packets on the sockets; `afspm.wire` is one.

    Methods that read frames raise `WireError` if the frames can't be read.
    """

    def decode_request(self, frames: Sequence[bytes], /) -> Request: ...
    def encode_request(self, request: Request, /) -> Sequence[bytes]: ...
    def decode_response(self, frames: Sequence[bytes], /) -> Response: ...
    def encode_response(self, response: Response, /) -> Sequence[bytes]: ...
    def id_of(self, frames: Sequence[bytes], /) -> str:
        """Return the id of a request, even a malformed one; "" without one."""
        ...

    def header(self, envelope: str, payload: bytes | memoryview, /) -> PacketHeader: ...


class ShellSockets(Protocol):
    """The connections of a scheduler: `SchedulerSockets`, or lines in memory.

    Attributes:
        history: returns the packets that a subscriber lacks when it joins.
        newest: returns the time of the newest kept packet of each envelope.
    """

    history: Callable[[Hashable, tuple[str, ...], int], Iterable[Packet]]
    newest: Callable[[], Mapping[str, int]]

    @property
    def due_s(self) -> float:
        """Real monotonic time at which `receive` must be called even if no source is ready."""
        ...

    def receive(self, ready: Sequence[Source]) -> Iterable[Sequence[SocketEvent]]:
        """Yield the events of each ready source, packets apart from all others, and let new subscribers join."""
        ...

    def reply(self, connection: int, frames: Sequence[bytes]) -> None: ...
    def send(self, number: int, frames: Sequence[bytes]) -> object:
        """Send a request to the translator, if it is connected."""
        ...

    def publish(self, packet: Packet) -> None: ...
    def end(self) -> None:
        """Send the end of the experiment to all subscribers, and to each that joins later."""
        ...

    def wake_up(self) -> None:
        """Let `handle` be called soon. Thread-safe."""
        ...


class ShellDisk(Protocol):
    """The memory that outlives the process: `WriteAhead`, or a simulated disk."""

    def write(self, state: SavedState | None, entries: Sequence[LoggedPacket], /) -> None:
        """Save the state and append the packets, before either is published."""
        ...

    def close(self) -> None: ...


class StepObserver(Protocol):
    """An observer of the decisions, in the order in which they take effect."""

    def decided(self, event: events.Input | None, effects: Sequence[events.Effect]) -> None:
        """Observe a decision before its effects are carried out; the event None is the start."""
        ...

    def carrying_out(self, effect: events.Effect) -> None:
        """Observe an effect just before it is carried out, after state and packets have been written."""
        ...

    def carried_out(self) -> None:
        """Observe that the effects of all decisions so far have been carried out."""
        ...


class SchedulerShell:
    """A running scheduler over its sockets and its disk.

    Call `start`, then `handle` whenever a source is ready or `due_s` has passed, until the scheduler is `over`.

    Args:
        messages: the encoding on the sockets.
        disk: state and packets are written there before they are published.
        warnings: messages about malformed input, which must not flood the log.
        worker: executes the jobs of the coordinate frame; None: the frame has no jobs.
        observer: sees each decision and effect.
    """

    def __init__(
        self,
        core: SchedulerCore,
        sockets: ShellSockets,
        messages: Messages,
        clock: Clock,
        disk: ShellDisk,
        warnings: RateLimitedLog,
        log: logging.Logger,
        worker: FrameWorker | None = None,
        observer: StepObserver | None = None,
    ) -> None:
        self._core = core
        self._sockets = sockets
        self._messages = messages
        self._clock = clock
        self._disk = disk
        self._warnings = warnings
        self._log = log
        self._replay: tuple[Packet, ...] = ()
        self._next_deadline_s = 0.0  # at the deadlines, in real monotonic time
        self.ended = False
        self._tip_is_safe = True
        self._worker = worker
        self._observer = observer
        if worker is not None:
            worker.wake = sockets.wake_up
        sockets.history, sockets.newest = self._history, core.newest

    def start(self) -> None:
        effects = self._core.start(self._clock.monotonic_s(), self._clock.now_ns())
        self._carry_out(self._seen(None, effects))

    @property
    def due_s(self) -> float:
        """Real monotonic time at which `handle` must be called even if no source is ready."""
        return min(self._core.leave_at_s if self.ended else self._next_deadline_s, self._sockets.due_s)

    @property
    def over(self) -> bool:
        """Whether the experiment and the grace period after it have ended."""
        return self.ended and self._clock.monotonic_s() >= self._core.leave_at_s

    def handle(self, ready: Sequence[Source]) -> None:
        """Process the worker's reports and incoming messages, then expired deadlines."""
        for report in () if self._worker is None or self.ended else self._worker.reports():
            self._step_with(events.FrameReported(report))
        for incoming in self._sockets.receive(ready):
            self._take(incoming)
        if self.ended:
            return
        now_s = self._clock.monotonic_s()
        if now_s >= self._next_deadline_s:
            self._deadlines(now_s)
        elif now_s + _LATE_S < self._next_deadline_s:
            self._next_deadline_s = now_s + _LATE_S  # the messages may have set an earlier deadline

    def _take(self, incoming: Sequence[SocketEvent]) -> None:
        # small packets go to the disk's thread together: handing one over and waiting takes as long as receiving and
        # publishing it
        effects, size = list[events.Effect](), 0
        for event in incoming:
            if not isinstance(event, PacketReceived | CaughtUp):
                self._take_one(event)
                continue
            if self.ended:
                continue
            effects += self._of_translator(event)
            size += len(event.packet.payload) if isinstance(event, PacketReceived) else 0
            if size >= _TOGETHER_BYTES:
                self._carry_out(effects)
                effects, size = [], 0
        if effects:
            self._carry_out(effects)

    def _of_translator(self, event: PacketReceived | CaughtUp) -> list[events.Effect]:
        if isinstance(event, CaughtUp):
            return self._decide(events.TranslatorCaughtUp())
        packet = event.packet
        try:
            header = self._messages.header(packet.envelope, packet.payload)
        except WireError as error:
            self._warnings.warning(f"dropped a packet of the translator: {error}")
            return []
        return self._decide(events.PacketIn(packet, header))

    def _take_one(self, event: SocketEvent) -> None:
        match event:
            case PeerAsked():
                self._request(event)
            case LinkUp() if self.ended:
                self._close_translator()
            case _ if self.ended:
                return
            case PeerConnected():
                self._step_with(events.Connected(event.connection))
            case PeerDisconnected():
                self._step_with(events.Disconnected(event.connection))
            case LinkReply():
                self._step_with(events.TranslatorReply(event.number, self._response(event)))
            case LinkUp():
                self._step_with(events.TranslatorUp())
            case LinkDown():
                self._step_with(events.TranslatorDown())

    def _close_translator(self) -> None:
        # a translator subscribes to nothing, so CLOSE is sent to it. With a tip in danger it gets none: it retracts the
        # tip by itself when it is stopped or its parent has gone
        if self._tip_is_safe:
            self._sockets.send(0, [wire.CLOSE])

    def stop(self) -> None:
        """Save the duty towards a tip in danger for a resumed run, unless the experiment has ended."""
        if not self.ended:
            self._step_with(events.Stopped())

    def close(self) -> None:
        """Stop the frame's worker, and flush the files."""
        if self._worker is not None:
            self._worker.close()
        self._disk.close()

    # --- inputs ---

    def _step_with(self, event: events.Input) -> None:
        self._carry_out(self._decide(event))

    def _decide(self, event: events.Input) -> list[events.Effect]:
        return self._seen(event, self._core.step(event, self._clock.monotonic_s(), self._clock.now_ns()))

    def _seen(self, event: events.Input | None, effects: list[events.Effect]) -> list[events.Effect]:
        if self._observer is not None:
            self._observer.decided(event, effects)
        return effects

    def _request(self, asked: PeerAsked) -> None:
        name, frames = asked.name, asked.frames
        if not frames:
            if not self.ended:
                self._step_with(events.Greeted(asked.connection, name, asked.user))
            return
        if self.ended and frames[0] not in _WRITTEN_DOWN_LATE:
            # after the end no request is decided, but final process states and late problems belong in the record
            ended = ResponseDetail.EXPERIMENT_ENDED
            response = Response(ControlResponse.FAILURE, b"", HAS_ENDED, self._messages.id_of(frames), ended)
            self._reply(asked.connection, response)
            return
        try:
            request = self._messages.decode_request(frames)
        except WireError as error:
            self._warnings.warning(f"refused a request of {name or 'a nameless peer'}: {error}")
            response = Response(error.response, reason=str(error), id=self._messages.id_of(frames))
            self._reply(asked.connection, response)
            self._step_with(events.Unreadable(name, response))
            return
        self._step_with(events.RequestIn(asked.connection, name, request, asked.user, self._clock.monotonic_s()))

    def _response(self, reply: LinkReply) -> Response:
        try:
            return self._messages.decode_response(reply.frames)
        except WireError as error:
            return Response(int(ControlResponse.FAILURE), reason=f"the translator's answer can't be read: {error}")

    def _history(self, subscriber: Hashable, prefixes: tuple[str, ...], since_ns: int) -> Iterable[Packet]:
        self._replay = ()
        self._step_with(events.ReplayRequested(subscriber, prefixes, since_ns))
        return self._replay

    def _deadlines(self, now_s: float) -> None:
        due_s = self._core_due_s()
        if due_s <= now_s:
            self._step_with(events.Tick())
            due_s = self._core_due_s()
        self._next_deadline_s = due_s

    def _core_due_s(self) -> float:
        due_s = self._core.deadline_s()
        if (deadline_ns := self._core.deadline_ns()) is not None:
            wait_s = self._clock.real_s((deadline_ns - self._clock.now_ns()) * 1e-9)
            due_s = min(math.inf if due_s is None else due_s, self._clock.monotonic_s() + wait_s)
        return math.inf if due_s is None else due_s

    # --- effects ---

    def _carry_out(self, effects: Sequence[events.Effect]) -> None:
        # first: a kill between two effects must leave nothing published that a restart does not know
        self._persist(effects)
        sockets = self._sockets
        for effect in effects:
            if self._observer is not None:
                self._observer.carrying_out(effect)
            match effect:
                case events.Reply():
                    self._reply(effect.connection, effect.response)
                case events.Forward():
                    sockets.send(effect.number, self._messages.encode_request(effect.request))
                case events.Publish():
                    sockets.publish(effect.packet)
                case events.Replay():
                    self._replay = effect.packets
                case events.Log():
                    self._log.log(_LEVELS.get(effect.level, logging.INFO), "%s", effect.text)
                case events.Delegate():
                    assert self._worker is not None, "a frame with jobs has a worker"
                    self._worker.take(effect.job)
                case events.Kill():
                    sockets.end()
                    self._tip_is_safe = effect.tip_is_safe
                    self._close_translator()
                    self.ended = True

        if self._observer is not None:
            self._observer.carried_out()

    def _reply(self, connection: int, response: Response) -> None:
        self._sockets.reply(connection, self._messages.encode_response(response))

    def _persist(self, effects: Sequence[events.Effect]) -> None:
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
        self._disk.write(state, entries)
