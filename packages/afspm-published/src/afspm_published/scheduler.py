"""Bridge for afspm components under a scheduler of the published implementation."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Final

import zmq

from afspm import wire
from afspm.basics import ConfigError, ExitCode, WireError
from afspm.model import ControlRequest, ControlResponse, Request, Response, ResponseDetail, Role, component_of
from afspm.transport import Network, ParentGone, PeerAsked, RateLimitedLog, Router
from afspm.transport.frames import receive_frames, send_frames
from afspm.transport.network import CONNECTED, DISCONNECTED, MAX_PACKET_BYTES, Monitor
from afspm.transport.port import Incoming
from afspm.transport.router import PeerConnected, PeerDisconnected, RouterEvent
from afspm.transport.zmq_port import BasePort
from afspm.wire.messages import CONTROL_STATE
from afspm_published import version_1

if TYPE_CHECKING:
    from afspm.transport import ProcessContext

CACHE_WITHIN_S: Final = 2.0
"""Real time within which a scheduler of version 1 sends its cache; no message marks the end of the cache."""
LINGER_S: Final = 1.0
MOST_ANSWERS: Final = 256
"""Remembered answers per client, for repeated requests."""


class PublishedScheduler:
    """An afspm scheduler that passes requests on to a scheduler of the published implementation.

    The microscope belongs to the published scheduler: the experiment file has no translator.

    Args:
        serve: address of the published scheduler's router.
        publish: address of the published scheduler's publisher.
        control, limits, cache: sections of the experiment file, which the published scheduler's own configuration
            replaces. Limits are refused, since nothing would enforce them.

    Raises:
        ConfigError: `limits` has parameters, actions or sets.
    """

    role: ClassVar[Role] = Role.SCHEDULER
    microscope_elsewhere: ClassVar[str] = (
        "leave it out here; afspm's microscope serves the published scheduler from an experiment of its own, with "
        "Scheduler and PublishedPeers (as_translator = true), since its own ports are encrypted: "
        "see packages/afspm-published/docs/under-a-published-mediator.md"
    )
    """Advice for an experiment file that has a microscope beside this scheduler."""

    def __init__(
        self,
        serve: str,
        publish: str,
        control: Mapping[str, object] | None = None,
        limits: Mapping[str, object] | None = None,
        cache: Mapping[str, object] | None = None,
    ) -> None:
        if any((limits or {}).get(kind) for kind in ("parameters", "actions", "sets", "forbid")):
            raise ConfigError(
                "a scheduler of the published implementation enforces no limits",
                where="limits",
                hint="leave out [limits]; or use afspm's Scheduler, and let their programs join by PublishedPeers",
            )
        self._serve, self._publish = serve, publish

    def run_process(self, context: ProcessContext) -> int:
        """Run until the experiment ends or the parent is gone."""
        stopping = threading.Event()
        port = _SchedulerPort(context, self._serve, self._publish)

        def stop() -> None:
            stopping.set()
            port.wake_up(ParentGone())

        context.when_stopping(stop)
        try:
            while not (stopping.is_set() or port.is_over()):
                port.poll(port.due_in_s())
                port.open_when_cached()
            return ExitCode.ORPHAN if stopping.is_set() else ExitCode.ENDED
        finally:
            port.close()


class _ClientOutside:
    """Connection of one afspm client to the published scheduler.

    Attributes:
        connection: the newest connection of the client.
        asked: unanswered requests, oldest first; only the first is sent, as a REQ socket would do.
        answers: answers to the latest requests, by id.
    """

    def __init__(self, bridge: _SchedulerPort, name: str) -> None:
        self._bridge = bridge
        self._network = version_1.outside(bridge.launch)
        self.socket = self._network.socket(zmq.DEALER)
        # the published scheduler knows a client only by its socket's identity
        self.socket.setsockopt(zmq.ROUTING_ID, name.encode())
        self.monitor = Monitor(self._network, self.socket, CONNECTED | DISCONNECTED)
        self._network.connect(self.socket, bridge.serve_outside)
        self.connection = -1
        self.asked: list[Request] = []
        self.answers: dict[str, Response] = {}
        self._is_open = False
        self._is_sent = False

    def ask(self, request: Request) -> None:
        """Send a request once earlier requests are answered; resend the known answer to a repeated request."""
        if request.id and request.id in self.answers:
            self._bridge.reply(self, self.answers[request.id])
        elif not request.id or all(request.id != one.id for one in self.asked):
            self.asked.append(request)
            self._send_next()

    def receive(self) -> list[Incoming]:
        while frames := receive_frames(self.socket):
            content = [frame.bytes for frame in frames]
            if content[:1] != [b""] or not self._is_sent:
                continue
            try:
                response = wire.decode_response(content[1:])
            except WireError as error:
                response = Response(
                    int(ControlResponse.FAILURE), reason=f"the scheduler's answer is malformed: {error}"
                )
            self._answered(response)
        return []

    def follow(self) -> list[Incoming]:
        for event in self.monitor.drain():
            was_sent, self._is_open, self._is_sent = self._is_sent, event.kind == CONNECTED, False
            if was_sent:  # a repeated request might be carried out twice
                why = "the connection to the scheduler was lost before it answered"
                detail = ResponseDetail.OUTCOME_UNKNOWN
                self._is_sent = True
                self._answered(Response(int(ControlResponse.NO_RESPONSE), b"", why, "", detail))
        self._send_next()
        return []

    def close(self) -> None:
        self._network.close()

    def _send_next(self) -> None:
        while self._is_open and not self._is_sent and self.asked:
            request = self.asked[0]
            self._is_sent = True
            if (known := self._bridge.known_answer(request)) is not None:
                self._answered(known)
            else:
                send_frames(self.socket, [b"", *version_1.request_frames(request)])

    def _answered(self, response: Response) -> None:
        request, self._is_sent = self.asked.pop(0), False
        self._bridge.note(request, response)
        response.id = request.id
        if request.id:
            self.answers[request.id] = response
            while len(self.answers) > MOST_ANSWERS:
                del self.answers[next(iter(self.answers))]
        self._bridge.reply(self, response)
        self._send_next()


class _SchedulerPort(BasePort[Incoming]):
    """All sockets of the process: one per afspm client towards the published scheduler, and an afspm scheduler's."""

    def __init__(self, context: ProcessContext, serve: str, publish: str) -> None:
        launch = context.launch
        if launch.sockets.publish is None or launch.sockets.serve is None:
            raise ConfigError("a scheduler needs two addresses: publish and serve", where=launch.name)
        super().__init__(Network.from_launch(launch.name, launch.keys), context.clock, launch.sockets.publish)
        self.launch = launch
        self.serve_outside = serve
        self._warnings = RateLimitedLog(logging.getLogger("afspm.transport"), context.clock)
        self._router: Router | None = None
        self._clients: dict[str, _ClientOutside] = {}
        self._names: dict[int, str] = {}
        self._flagged: set[int] = set()  # as published
        self._unpublished: set[int] = set()  # flagged by clients here, and not published yet
        self._ends_s = math.inf
        self._outside = version_1.outside(launch)
        self._sub = self._outside.socket(zmq.SUB, max_bytes=MAX_PACKET_BYTES)
        # a single subscription: the published scheduler processes one subscription per loop
        self._sub.setsockopt(zmq.SUBSCRIBE, b"")
        self._monitor = Monitor(self._outside, self._sub, CONNECTED)
        self._opens_s = math.inf
        self._outside.connect(self._sub, publish)
        self._poller.register(self._sub, self._packets)
        self._poller.register(self._monitor.socket, self._connected)

    def due_in_s(self) -> float | None:
        """Return the longest time to wait for messages, in s; None: no limit."""
        due_s = min(self._ends_s, self._opens_s)
        return None if due_s == math.inf else due_s - self._clock.monotonic_s()

    def is_over(self) -> bool:
        """Return whether the experiment has ended, and the time for last answers has passed."""
        return self._clock.monotonic_s() >= self._ends_s

    def open_when_cached(self) -> None:
        """Accept afspm's components from `CACHE_WITHIN_S` after the connection to the published scheduler."""
        if self._clock.monotonic_s() >= self._opens_s and self.launch.sockets.serve is not None:
            self._opens_s = math.inf
            self._router = Router(self._network, self.launch.sockets.serve, self._warnings, self._clock)
            self._poller.register(self._router.socket, self._requests)
            self._poller.register(self._router.monitor.socket, self._requests)

    def known_answer(self, request: Request) -> Response | None:
        """Return the answer to a request that would crash the published scheduler; None if the request can be sent."""
        if not version_1.has_request(request.kind):
            return version_1.unknown_request(request.kind, "scheduler", request.id)
        if request.kind == ControlRequest.RMV_EXP_PRBLM and request.subject not in self._flagged | self._unpublished:
            return Response(int(ControlResponse.SUCCESS))  # the published scheduler ends if the problem is not set
        return None

    def note(self, request: Request, response: Response) -> None:
        """Update the set of flagged problems after a successful request that adds or removes a problem."""
        if response.ok and request.kind == ControlRequest.ADD_EXP_PRBLM:
            self._unpublished.add(int(request.subject))
        elif response.ok and request.kind == ControlRequest.RMV_EXP_PRBLM:
            self._unpublished.discard(int(request.subject))
            self._flagged.discard(int(request.subject))

    def reply(self, client: _ClientOutside, response: Response) -> None:
        """Answer through the newest connection of a client."""
        if self._router is not None:
            self._router.reply(client.connection, wire.encode_response(response))

    def close(self) -> None:
        for client in self._clients.values():
            client.close()
        super().close()
        self._outside.close()

    # --- inside: components ---

    def _requests(self) -> list[Incoming]:
        if self._router is not None:
            for event in self._router.receive():
                self._take(event)
        return []

    def _take(self, event: RouterEvent) -> None:
        match event:
            case PeerAsked(connection, name, user, frames) if frames:
                self._asked(connection, name, user, [bytes(frame) for frame in frames])
            case PeerAsked() | PeerConnected():
                pass
            case PeerDisconnected(connection):
                name = self._names.pop(connection, "")
                client = self._clients.get(name)
                if client is not None and client.connection == connection:
                    # the published scheduler notices a client's end only by its connection
                    self._forget(name)

    def _asked(self, connection: int, name: str, user: str | None, frames: list[bytes]) -> None:
        refusal = None
        try:
            request = wire.decode_request(frames)
        except WireError as error:
            request_id = frames[2].decode("utf-8", "replace") if len(frames) > 2 else ""
            refusal = Response(error.response, b"", str(error), request_id)
        else:
            if not name or (user is not None and user != component_of(name)):
                why = f"the name {name!r} does not belong to its key" if name else "a client without a name"
                refusal = Response(int(ControlResponse.FAILURE), b"", why, request.id)
            elif not version_1.has_request(request.kind):
                refusal = version_1.unknown_request(request.kind, "scheduler", request.id)
        if refusal is not None:
            if self._router is not None:
                self._router.reply(connection, wire.encode_response(refusal))
            return
        client = self._client(name)
        client.connection = connection
        self._names[connection] = name
        client.ask(request)

    def _client(self, name: str) -> _ClientOutside:
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = _ClientOutside(self, name)
            self._poller.register(client.socket, client.receive)
            self._poller.register(client.monitor.socket, client.follow)
        return client

    def _forget(self, name: str) -> None:
        client = self._clients.pop(name)
        self._poller.forget(client.socket)
        self._poller.forget(client.monitor.socket)
        client.close()

    # --- outside: the published scheduler ---

    def _connected(self) -> list[Incoming]:
        if self._monitor.drain() and self._router is None:
            self._opens_s = self._clock.monotonic_s() + CACHE_WITHIN_S
        return []

    def _packets(self) -> list[Incoming]:
        while frames := receive_frames(self._sub):
            content = [frame.bytes for frame in frames]
            if content == [wire.KILL]:
                if self._publisher is not None:
                    self._publisher.kill()
                self._ends_s = min(self._ends_s, self._clock.monotonic_s() + LINGER_S)
                continue
            try:
                packet = wire.decode_packet(content)
                if wire.message_of(packet.envelope) == CONTROL_STATE.name:
                    self._flagged = set(wire.decode(CONTROL_STATE.name, packet.payload).problems)
                    self._unpublished -= self._flagged
            except WireError as error:
                self._warnings.warning(f"dropped a packet of their scheduler: {error}")
                continue
            if self._publisher is not None:
                stamped = self._published.stamp(packet.envelope, bytes(packet.payload), packet.time_ns)
                self._publisher.publish(stamped)
        return []
