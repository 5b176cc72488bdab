"""Sockets and disk around the scheduler's decisions: what comes in becomes inputs, effects are carried out."""

from __future__ import annotations

import logging
import math
from collections.abc import Hashable, Iterable
from typing import TYPE_CHECKING

from afspm import wire
from afspm.errors import WireError
from afspm.logic import events
from afspm.model import ControlResponse, Packet, Response
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.router import PeerAsked, PeerConnected
from afspm.transport.translator_link import LinkReply, LinkUp
from afspm.wire.frames import LONGEST_ID

if TYPE_CHECKING:
    from afspm.clock import Clock
    from afspm.logic.scheduling import SchedulerCore
    from afspm.scheduler.journal import Journal
    from afspm.scheduler.state_file import StateFile
    from afspm.transport.complaints import Complaints
    from afspm.transport.scheduler_sockets import SchedulerSockets, Source

_LEVELS = logging.getLevelNamesMapping()


class Shell:
    """One scheduler at work: `start`, then `handle` what `wait` returns until it has `ended`."""

    def __init__(
        self,
        core: SchedulerCore,
        sockets: SchedulerSockets,
        clock: Clock,
        state: StateFile,
        journal: Journal,
        complaints: Complaints,
        log: logging.Logger,
    ) -> None:
        self._core = core
        self._sockets = sockets
        self._clock = clock
        self._state = state
        self._journal = journal
        self._complaints = complaints
        self._log = log
        self._replay: tuple[Packet, ...] = ()
        self.ended = False
        sockets.publisher.history = self._history

    def start(self) -> None:
        self._carry_out(self._core.start(self._clock.monotonic_s(), self._clock.now_ns()))

    def wait(self) -> list[Source]:
        """Wait for whatever comes first, a message or a deadline."""
        return self._sockets.wait(self._timeout_ms())

    def handle(self, ready: list[Source]) -> None:
        """See to what has come, and to the deadlines."""
        sockets = self._sockets
        for source in ready:
            if source is sockets.router:
                self._requests()
            elif source is sockets.link:
                self._translator()
            elif source is sockets.subscriber:
                self._packets()
            else:
                sockets.publisher.serve()
        self._deadlines()

    def close(self) -> None:
        """Write down what is cached, unless the experiment is over."""
        if not self.ended:
            self._journal.follow(self._core.cached())
        self._journal.close()

    # --- what comes in ---

    def _take(self, event: events.Input) -> None:
        self._carry_out(self._core.step(event, self._clock.monotonic_s(), self._clock.now_ns()))

    def _requests(self) -> None:
        for event in self._sockets.router.receive():
            if isinstance(event, PeerAsked):
                self._request(event)
            elif isinstance(event, PeerConnected):
                self._take(events.Connected(event.connection))
            else:
                self._take(events.Disconnected(event.connection))

    def _request(self, asked: PeerAsked) -> None:
        name = asked.name
        if not asked.frames:
            self._take(events.Greeted(asked.connection, name, asked.user))
            return
        try:
            request = wire.decode_request(asked.frames)
        except WireError as error:
            self._complaints.say(f"refused a request of {name or 'a nameless peer'}: {error}")
            response = Response(error.response, reason=str(error), id=_id_of(asked))
            self._sockets.router.reply(asked.connection, wire.encode_response(response))
            return
        self._take(events.RequestIn(asked.connection, name, request, asked.user))

    def _translator(self) -> None:
        for event in self._sockets.link.receive():
            if isinstance(event, LinkReply):
                self._take(events.TranslatorReply(event.number, _response(event)))
            else:
                self._take(events.TranslatorUp() if isinstance(event, LinkUp) else events.TranslatorDown())

    def _packets(self) -> None:
        for incoming in self._sockets.subscriber.receive():
            if isinstance(incoming, CaughtUp):
                self._take(events.TranslatorCaughtUp())
            if not isinstance(incoming, PacketReceived):
                continue
            packet = incoming.packet
            try:
                header = wire.header(packet.envelope, packet.payload)
            except WireError as error:
                self._complaints.say(f"dropped a packet of the translator: {error}")
                continue
            self._take(events.PacketIn(packet, header))

    def _history(self, subscriber: Hashable, prefixes: tuple[str, ...], since_ns: int) -> Iterable[Packet]:
        self._replay = ()
        self._take(events.SubscriberJoined(subscriber, prefixes, since_ns))
        return self._replay

    def _deadlines(self) -> None:
        now_s = self._clock.monotonic_s()
        due_s = self._journal.due_s
        if due_s is not None and now_s >= due_s:
            self._journal.follow(self._core.cached())
        if self._wait_s(now_s) <= 0.0:
            self._take(events.Tick())

    def _wait_s(self, now_s: float) -> float:
        """Real seconds until the next deadline of the core's."""
        wait_s = math.inf
        if (deadline_s := self._core.deadline_s()) is not None:
            wait_s = deadline_s - now_s
        if (deadline_ns := self._core.deadline_ns()) is not None:
            wait_s = min(wait_s, self._clock.real_s((deadline_ns - self._clock.now_ns()) * 1e-9))
        return wait_s

    def _timeout_ms(self) -> int | None:
        now_s = self._clock.monotonic_s()
        wait_s = self._wait_s(now_s)
        if (due_s := self._journal.due_s) is not None:
            wait_s = min(wait_s, due_s - now_s)
        # rounded up: woken up before the deadline we would only come back
        return None if wait_s == math.inf else max(0, math.ceil(wait_s * 1000.0))

    # --- what goes out ---

    def _carry_out(self, effects: Iterable[events.Effect]) -> None:
        sockets = self._sockets
        for effect in effects:
            match effect:
                case events.Reply():
                    sockets.router.reply(effect.connection, wire.encode_response(effect.response))
                case events.Forward():
                    sockets.link.send(effect.number, wire.encode_request(effect.request))
                case events.Publish():
                    sockets.publisher.publish(effect.packet)
                    if effect.cached:
                        self._journal.changed()
                case events.Replay():
                    self._replay = effect.packets
                case events.SaveState():
                    self._state.save(effect.state)
                case events.Log():
                    self._log.log(_LEVELS.get(effect.level, logging.INFO), "%s", effect.text)
                case events.Kill():
                    sockets.publisher.kill()
                    self.ended = True


def _id_of(asked: PeerAsked) -> str:
    """The id of a malformed request, if that much of it is well-formed: its sender then knows what was refused."""
    if len(asked.frames) == 3 and len(asked.frames[2]) <= LONGEST_ID:
        return asked.frames[2].decode("utf-8", "replace")
    return ""


def _response(reply: LinkReply) -> Response:
    try:
        return wire.decode_response(reply.frames)
    except WireError as error:
        return Response(int(ControlResponse.FAILURE), reason=f"the translator's answer can't be read: {error}")
