"""The scheduler as a simulated process: its real shell and core, with lines in memory and a simulated disk."""

from __future__ import annotations

import json
import logging
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from afspm import wire
from afspm.basics.exit_codes import ExitCode
from afspm.components import snapshot
from afspm.model import LoggedPacket, Packet, Request, Response
from afspm.model.events import component_of
from afspm.model.snapshot import restored
from afspm.scheduler import Codec, Input, SavedState, SchedulerCore
from afspm.scheduler.events import Effect
from afspm.scheduler.saved_state import KIND, VERSION
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.shell import FrameWorker, Messages, SchedulerShell
from afspm.testing.components.memory_network import (
    ControlLine,
    Feed,
    LineServer,
    PacketSource,
    Subscribers,
    Weather,
)
from afspm.testing.components.simulated_process import Process, ProcessTimer
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.transport.late_joiners import History, Newest
from afspm.transport.port import CaughtUp, PacketReceived
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.router import PeerAsked, PeerConnected, PeerDisconnected, RouterEvent
from afspm.transport.scheduler_sockets import LinkDown, LinkReply, LinkUp, SocketEvent, Source

_SOURCE = "memory://translator"
_TURN_S = 0.002
"""Longest time between the arrival of a message and the turn of the scheduler that handles it."""
_SILENT = logging.getLogger("afspm.simulated-scheduler")
_SILENT.disabled = True


class _Died(Exception):
    """The end of a life in the middle of a step."""


@dataclass
class SimulatedDisk:
    """The data that survives a kill of the scheduler.

    Attributes:
        state: the last saved state, a frozen object, converted to plain data only for a restart.
        journal: the packets to publish again after a restart, by envelope and time, in ns.
        full: True if nothing can be written.
        delay_s: the real time that a write takes; a kill loses the writes under way.
        stale: True while the newest state or packet is not on the disk.
        losses: number of lives that ended with writes under way.
        forgotten: the translator's times of packets that were published, and that the end of a life took from the disk
            before they were synced. The saved state does not list them, so a restart publishes them at another time.
    """

    state: SavedState | None = None
    journal: dict[str, dict[int, LoggedPacket]] = field(default_factory=dict)
    full: bool = False
    delay_s: float = 0.0
    stale: bool = False
    losses: int = 0
    forgotten: set[int] = field(default_factory=set)

    def keep(self, entry: LoggedPacket) -> None:
        """Append a packet; see `afspm.storage.packet_log.cached_packets`."""
        if not entry.history:
            return
        of_envelope = self.journal.setdefault(entry.packet.envelope, {})
        of_envelope[entry.packet.time_ns or 0] = entry
        while len(of_envelope) > entry.history:
            del of_envelope[min(of_envelope)]

    def packets(self) -> list[LoggedPacket]:
        """Return the packets to publish again after a restart, oldest first."""
        entries = [entry for of_envelope in self.journal.values() for entry in of_envelope.values()]
        return sorted(entries, key=lambda entry: entry.packet.time_ns or 0)

    def saved(self) -> SavedState | None:
        """Return the state as read back from a JSON file; None if none was saved."""
        if self.state is None:
            return None
        return restored(SavedState, json.loads(json.dumps(snapshot(self.state, KIND, VERSION))), KIND, VERSION)


class SimulatedWriteAhead:
    """The shell's disk in one life: the counterpart of `afspm.scheduler.write_ahead.WriteAhead`."""

    def __init__(self, host: SchedulerHost) -> None:
        self._host = host
        self._disk = host.disk
        self._under_way: deque[tuple[SavedState | None, Sequence[LoggedPacket]]] = deque()
        self._unsynced: list[LoggedPacket] = []
        self._missed_ns: int | None = None
        self._missed_state: SavedState | None = None
        self._last_s = 0.0

    def write(self, state: SavedState | None, entries: Sequence[LoggedPacket]) -> None:
        """Write at once, or after the disk's delay; a full disk takes nothing."""
        if state is None and not entries:
            return
        now_s = self._host.timeline.monotonic_s()
        self._last_s = max(self._last_s, now_s + self._disk.delay_s)
        self._under_way.append((state, entries))
        if self._last_s <= now_s:
            self._arrives()
        else:
            self._disk.stale = True
            self._host.later(self._last_s - now_s, self._host.guarded, self._arrives)

    def end(self) -> None:
        """Lose the writes under way, and the packets that are not synced."""
        self._disk.losses += bool(self._under_way)
        self._under_way.clear()
        remembered = {source_ns for source_ns, _ in (self._disk.state.recent if self._disk.state else ())}
        lost = {entry.source_ns for entry in self._unsynced if entry.source_ns is not None}
        self._disk.forgotten |= lost - remembered

    def close(self) -> None:
        """Do nothing: all writes have arrived."""

    def _arrives(self) -> None:
        state, entries = self._under_way.popleft()
        if self._disk.full:
            times = [entry.packet.time_ns or 0 for entry in entries]
            self._missed_ns = min(times if self._missed_ns is None else [self._missed_ns, *times], default=None)
            self._missed_state = state or self._missed_state
            self._disk.stale = True
            return
        state, self._missed_state = state or self._missed_state, None
        self._host.may_die()
        self._disk.stale = bool(self._under_way)
        if state is not None:
            self._disk.state = state
            self._host.may_die()
        for entry in (*self._missed(), *entries):
            if entry.source_ns is None or not self._host.unsynced_s:
                self._disk.keep(entry)
                continue
            if not self._unsynced:
                self._host.later(self._host.unsynced_s * self._host.timeline.random.random(), self._sync)
            self._unsynced.append(entry)

    def _sync(self) -> None:
        for entry in self._unsynced:
            self._disk.keep(entry)
        self._unsynced.clear()

    def _missed(self) -> list[LoggedPacket]:
        missed_ns, self._missed_ns = self._missed_ns, None
        if missed_ns is None:
            return []
        return [entry for entry in self._host.core.cached() if (entry.packet.time_ns or 0) >= missed_ns]


class StepChecker(Protocol):
    """An observer that checks each step of the scheduler."""

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Check the state after the effects of a step were carried out."""
        ...

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        """Check an effect just before it is carried out."""
        ...


class ClientLines:
    """The lines of clients, numbered and named as connections of a ROUTER socket."""

    def __init__(self) -> None:
        self._opened = 0  # over all lives
        self.forget()

    def forget(self) -> None:
        """Forget the lines of a life that has ended."""
        self._numbers: dict[ControlLine, int] = {}
        self._by_number: dict[int, ControlLine] = {}
        self._by_name: dict[str, ControlLine] = {}

    def open(self, line: ControlLine) -> int:
        """Return the connection's number, which no other connection of any life has."""
        self._opened += 1
        self._numbers[line], self._by_number[self._opened] = self._opened, line
        return self._opened

    def hand_over_name(self, line: ControlLine) -> None:
        """Cut an older line of the same name: ROUTER hands the name over to the newest connection."""
        former = self._by_name.get(line.name)
        self._by_name[line.name] = line
        if former is not None and former is not line:
            former.cut()

    def close(self, line: ControlLine) -> int | None:
        """Return the number of the closed connection; None if it is of an earlier life."""
        connection = self._numbers.pop(line, None)
        if connection is None:
            return None
        del self._by_number[connection]
        if self._by_name.get(line.name) is line:
            del self._by_name[line.name]
        return connection

    def number(self, line: ControlLine) -> int | None:
        return self._numbers.get(line)

    def line(self, number: int) -> ControlLine | None:
        return self._by_number.get(number)


class SimulatedSockets:
    """The shell's sockets in one life: `afspm.transport.scheduler_sockets.SchedulerSockets`, with lines in memory.

    The events wait for the next turn of the process, and come by their source, as from a poller: those of the clients
    first, then answers and packets of the translator, then the changes of its connection.

    Attributes:
        history, newest: see `afspm.scheduler.shell.ShellSockets`.
        due_s: never.
    """

    due_s = math.inf

    def __init__(
        self, host: SchedulerHost, weather: Weather, messages: Messages, server: LineServer, publisher: PacketSource
    ) -> None:
        self.history: History = lambda subscriber, prefixes, since_ns: ()
        self.newest: Newest = dict  # lines in memory lose no packet of a connection, and need no beacon
        self._host = host
        self._messages = messages
        self._clients = host.clients
        self._subscribers = Subscribers()
        self._has_ended = False
        self._peers: list[RouterEvent] = []
        self._answers: list[LinkReply] = []
        self._packets: list[PacketReceived | CaughtUp] = []
        self._changes: list[LinkUp | LinkDown] = []
        self.link = ControlLine(host.timeline, weather, host, server, "scheduler", doubling=False)
        self.feed = Feed(host.timeline, weather, host, publisher)

    def close(self) -> None:
        self.link.close()
        self.feed.close()

    # --- arrivals ---

    def peer(self, event: RouterEvent) -> None:
        self._peers.append(event)
        self._host.take_a_turn()

    def answered(self, number: int, response: Response) -> None:
        self._answers.append(LinkReply(number, self._messages.encode_response(response)))
        self._host.take_a_turn()

    def changed(self, change: LinkUp | LinkDown) -> None:
        self._changes.append(change)
        self._host.take_a_turn()

    def received(self, event: PacketReceived | CaughtUp) -> None:
        self._packets.append(event)
        self._host.take_a_turn()

    def joined(self, feed: Feed, prefixes: tuple[str, ...], since_ns: int) -> Sequence[Packet]:
        """Return the packets that a new subscriber lacks."""
        missed = tuple(self.history(feed, prefixes, since_ns))
        self._subscribers.join(feed)
        if self._has_ended:
            self._host.later(0.0, feed.kill_signal)  # after the replay: it is over
        return missed

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)

    # --- for the shell ---

    def receive(self, ready: Sequence[Source]) -> Iterator[Sequence[SocketEvent]]:
        """Yield the events that have arrived, by source."""
        for queue in (self._peers, self._answers, self._packets, self._changes):
            came: Sequence[SocketEvent] = tuple(queue)
            queue.clear()
            if came:
                yield came

    def reply(self, connection: int, frames: Sequence[bytes]) -> None:
        """Answer a client, if it is still connected."""
        line = self._clients.line(connection)
        if line is not None:
            line.answer(self._messages.decode_response(frames))

    def send(self, number: int, frames: Sequence[bytes]) -> None:
        """Send a request to the translator, if it is connected."""
        is_close = list(frames) == [wire.CLOSE]
        self.link.ask(Request(wire.CLOSE[0]) if is_close else self._messages.decode_request(frames), number)

    def publish(self, packet: Packet) -> None:
        self._subscribers.publish(packet)

    def end(self) -> None:
        """Send the end of the experiment to all subscribers, and to each that joins later."""
        self._subscribers.kill_signal()
        self._has_ended = True

    def wake_up(self) -> None:
        self._host.take_a_turn()


class SchedulerHost(Process):
    """A scheduler with the real shell, on simulated sockets and a simulated disk.

    Args:
        messages: the encoding of requests on the sockets, as `afspm.wire`.
        observer: checks each step.
        dies_in_step: the chance of a kill before each effect of a step, and within each write to the disk.
        unsynced_s: longest time for which the translator's packets are not yet safe from the end of a life, as in a
            power cut; 0: all writes are.
        has_keys: whether each peer is known by the owner of its key, as in a run with keys.
        make_core: creates the core of each life; by default a `SchedulerCore`.

    Attributes:
        translator: the translator as a server of requests, and as a publisher; set before the first life.
        worker: executes jobs of the coordinate frame in this life; None: the frame has no jobs.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        settings: SchedulerSettings,
        codec: Codec,
        messages: Messages,
        observer: StepChecker,
        *,
        dies_in_step: float = 0.0,
        unsynced_s: float = 0.0,
        has_keys: bool = False,
        make_core: Callable[[], SchedulerCore] | None = None,
    ) -> None:
        super().__init__(timeline, "scheduler")
        self._make_core: Callable[[], SchedulerCore] = make_core or (lambda: SchedulerCore(settings, codec))
        self.core = self._make_core()
        self.disk = SimulatedDisk()
        self.dies_in_step = dies_in_step
        self.unsynced_s = unsynced_s
        self.has_keys = has_keys
        self.translator: tuple[LineServer, PacketSource] | None = None
        self.worker: FrameWorker | None = None
        self.clients = ClientLines()
        self._weather = weather
        self._messages = messages
        self._observer = observer
        self._decisions: list[tuple[Input | None, Sequence[Effect]]] = []

    # --- lives ---

    def begin(self) -> None:
        self.clients.forget()
        self._decisions.clear()
        self._turn_is_due = False
        self._due = ProcessTimer(self, self._turn)
        self.core = self._make_core()
        if (saved := self.disk.saved()) is not None:
            self.core.restore(saved)
        self.core.restore_cache(self.disk.packets())
        assert self.translator is not None
        self._writes = SimulatedWriteAhead(self)
        self._sockets = SimulatedSockets(self, self._weather, self._messages, *self.translator)
        self._shell = SchedulerShell(
            self.core,
            self._sockets,
            self._messages,
            self.timeline,
            self._writes,
            RateLimitedLog(_SILENT, self.timeline),
            _SILENT,
            self.worker,
            self,
        )
        self.guarded(self._shell.start)

    def fall_silent(self, for_s: float) -> None:
        """Lose the translator's messages in one or both directions, and break its connections after `for_s`."""
        if self.alive:
            self._sockets.link.fall_silent(for_s)
            self._sockets.feed.fall_silent(for_s)

    def ended(self) -> None:
        self._writes.end()
        self._sockets.close()
        self._due.set(None)

    def may_die(self) -> None:
        """End this life now, with probability `dies_in_step`.

        Raises:
            _Died: caught by `guarded`.
        """
        if self.dies_in_step and self.timeline.chance(self.dies_in_step):
            raise _Died

    def guarded(self, do: Callable[[], None]) -> None:
        """Call a method of the shell or its disk, which may end this life."""
        try:
            do()
        except _Died:
            self.kill()
        else:
            self._plan()

    # --- turns ---

    def take_a_turn(self) -> None:
        """Let the shell handle the arrived messages soon."""
        if not self._turn_is_due:
            self._turn_is_due = True
            self.later(_TURN_S * self.timeline.random.random(), self._turn)

    def _turn(self) -> None:
        self._turn_is_due = False
        self.guarded(lambda: self._shell.handle(()))

    def _plan(self) -> None:
        if self._shell.over:
            self.kill(ExitCode.ENDED)
        else:
            due_s = self._shell.due_s
            self._due.set(None if due_s == math.inf else max(0.0, due_s - self.timeline.monotonic_s()))

    # --- as the shell's observer ---

    def decided(self, event: Input | None, effects: Sequence[Effect]) -> None:
        self._decisions.append((event, effects))

    def carrying_out(self, effect: Effect) -> None:
        self.may_die()
        self._observer.carried_out(self, effect)

    def carried_out(self) -> None:
        decisions, self._decisions = self._decisions, []
        for event, effects in decisions:
            self._observer.stepped(self, event, effects)

    # --- as a server of requests ---

    def peer_connected(self, line: ControlLine) -> None:
        connection = self.clients.open(line)
        self._sockets.peer(PeerConnected(connection))
        self._sockets.peer(PeerAsked(connection, line.name, self._owner(line), []))
        self.clients.hand_over_name(line)

    def peer_disconnected(self, line: ControlLine) -> None:
        connection = self.clients.close(line)
        if connection is not None:
            self._sockets.peer(PeerDisconnected(connection))

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        self.peer_sent(line, self._messages.encode_request(request))

    def peer_sent(self, line: ControlLine, frames: Sequence[bytes]) -> None:
        """Take the frames of a peer, which need not be a request."""
        connection = self.clients.number(line)
        if connection is not None:
            self._sockets.peer(PeerAsked(connection, line.name, self._owner(line), frames))

    def _owner(self, line: ControlLine) -> str | None:
        return (line.owner or component_of(line.name)) if self.has_keys else None

    # --- as a client of the translator, and as a listener to it ---

    def line_up(self, line: ControlLine) -> None:
        self._sockets.changed(LinkUp())

    def line_down(self, line: ControlLine) -> None:
        self._sockets.changed(LinkDown())

    def answered(self, line: ControlLine, number: int, response: Response) -> None:
        self._sockets.answered(number, response)

    def since_ns(self, feed: Feed) -> int:
        return self.core.newest_source_ns

    def received(self, feed: Feed, packet: Packet) -> None:
        self._sockets.received(PacketReceived(packet, _SOURCE))

    def caught_up(self, feed: Feed) -> None:
        self._sockets.received(CaughtUp(_SOURCE))

    def killed(self, feed: Feed) -> None:
        """Do nothing: the translator sends no KILL."""

    # --- as a publisher ---

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        missed: list[Packet] = []
        self.guarded(lambda: missed.extend(self._sockets.joined(feed, tuple(prefixes), since_ns)))
        return missed

    def left(self, feed: Feed) -> None:
        self._sockets.left(feed)
