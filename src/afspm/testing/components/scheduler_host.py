"""The scheduler as a simulated process: the real `SchedulerCore`, with in-memory lines and an in-memory disk."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from afspm.model import (
    HAS_ENDED,
    RELAY_REQUEST,
    ControlResponse,
    LoggedPacket,
    Packet,
    PacketHeader,
    Request,
    Response,
    ResponseDetail,
)
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.events import (
    Codec,
    Connected,
    Delegate,
    Disconnected,
    Effect,
    Forward,
    FrameReported,
    Greeted,
    Input,
    Kill,
    PacketIn,
    Publish,
    Replay,
    ReplayRequested,
    Reply,
    RequestIn,
    SaveState,
    Tick,
    TranslatorCaughtUp,
    TranslatorDown,
    TranslatorReply,
    TranslatorUp,
)
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.shell import FrameWorker
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


@dataclass
class Disk:
    """The data that survives a kill of the scheduler.

    Attributes:
        state: the last saved state, a frozen object, converted to plain data only for a restart.
        journal: the packets to publish again after a restart.
        full: True if nothing can be written.
        stale: True if the last write failed.
    """

    state: SavedState | None = None
    journal: tuple[LoggedPacket, ...] = ()
    full: bool = False
    stale: bool = False

    def save(self, state: SavedState) -> None:
        self.stale = self.full
        if not self.full:
            self.state = state

    def keep(self, entry: LoggedPacket) -> None:
        """Store a packet before it is published; a full disk drops the packet."""
        if self.full:
            self.stale = True
            return
        self.journal = (*self.journal, entry)

    def saved(self) -> SavedState | None:
        """Return the state as read back from a JSON file; None if none was saved."""
        if self.state is None:
            return None
        return restored(SavedState, json.loads(json.dumps(snapshot(self.state, KIND, VERSION))), KIND, VERSION)


class StepObserver(Protocol):
    """An observer that checks each step of the scheduler."""

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None: ...
    def carried_out(self, host: SchedulerHost, effect: Effect) -> None: ...


class JournalWriter:
    """The writes of published packets to the journal on disk.

    Attributes:
        delay_s: longest delay between a packet and its write to the journal.
        writes_ahead: True if a packet is on disk before it is published, as in the shell. If False, a kill loses the
            translator's newest packets, which is harder on the scheduler.
    """

    def __init__(self, host: SchedulerHost, delay_s: float) -> None:
        self._host = host
        self._is_due = False
        self.delay_s = delay_s
        self.writes_ahead = False

    def begin(self) -> None:
        """Begin a new life: the writes due in the one before are lost."""
        self._is_due = False

    def before(self, publish: Publish) -> None:
        """Write a packet about to be published, if it has to be on disk first."""
        if publish.history and (publish.source_ns is None or self.writes_ahead):
            self._host.disk.keep(LoggedPacket(publish.packet, publish.source_ns, publish.history))

    def after(self, publish: Publish) -> None:
        """Plan a write of all cached packets soon after a packet was published."""
        if publish.history and not self._is_due:
            self._is_due = True
            self._host.later(self.delay_s * self._host.timeline.random.random(), self._write)

    def _write(self) -> None:
        self._is_due = False
        if not self._host.disk.full:
            self._host.disk.journal = tuple(self._host.core.cached())


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


class TranslatorConnections:
    """The scheduler's two connections to the translator in one life: requests there, packets back."""

    def __init__(self, host: SchedulerHost, weather: Weather, server: LineServer, publisher: PacketSource) -> None:
        self._requests = ControlLine(host.timeline, weather, host, server, "scheduler", doubling=False)
        self._packets = Feed(host.timeline, weather, host, publisher)

    def ask(self, request: Request, number: int) -> None:
        self._requests.ask(request, number)

    def fall_silent(self, for_s: float) -> None:
        self._requests.fall_silent(for_s)
        self._packets.fall_silent(for_s)

    def close(self) -> None:
        self._requests.close()
        self._packets.close()


class SchedulerHost(Process):
    """The counterpart of `afspm.scheduler.shell`, without sockets.

    Args:
        journal_s: longest delay between a packet and its write to the journal.
        dies_in_step: the chance of a kill before each effect of a step.
        make_core: creates the core of each life; by default a `SchedulerCore`.

    Attributes:
        translator: the translator as a server of requests, and as a publisher; set before the first life.
        worker: executes jobs of the coordinate frame in this life; None: only the observer receives the jobs.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        settings: SchedulerSettings,
        codec: Codec,
        header: Callable[[Packet], PacketHeader],
        observer: StepObserver,
        *,
        journal_s: float = 0.1,
        dies_in_step: float = 0.0,
        make_core: Callable[[], SchedulerCore] | None = None,
    ) -> None:
        super().__init__(timeline, "scheduler")
        self._make_core: Callable[[], SchedulerCore] = make_core or (lambda: SchedulerCore(settings, codec))
        self.core = self._make_core()
        self.disk = Disk()
        self.dies_in_step = dies_in_step
        self.translator: tuple[LineServer, PacketSource] | None = None
        self._weather = weather
        self._header = header
        self._observer = observer
        self.journal = JournalWriter(self, journal_s)
        self.worker: FrameWorker | None = None
        self._clients = ClientLines()
        self._forget()

    def _forget(self) -> None:
        self._clients.forget()
        self._subscribers = Subscribers()
        self.journal.begin()
        self._ticking = ProcessTimer(self, self._tick)
        self._replay: tuple[Packet, ...] = ()

    # --- lives ---

    def begin(self) -> None:
        self._forget()
        self.core = self._make_core()
        if (saved := self.disk.saved()) is not None:
            self.core.restore(saved)
        self.core.restore_cache(self.disk.journal)
        assert self.translator is not None
        self._link = TranslatorConnections(self, self._weather, *self.translator)
        self._carry_out(None, self.core.start(self.timeline.monotonic_s(), self.timeline.now_ns()))

    def fall_silent(self, for_s: float) -> None:
        """Lose the translator's messages in one or both directions, and break its connections after `for_s`."""
        if self.alive:
            self._link.fall_silent(for_s)

    def ended(self) -> None:
        self._link.close()
        self._ticking.set(None)

    # --- as a server of requests ---

    def peer_connected(self, line: ControlLine) -> None:
        connection = self._clients.open(line)
        self._step(Connected(connection))
        self._step(Greeted(connection, line.name))
        self._clients.hand_over_name(line)

    def peer_disconnected(self, line: ControlLine) -> None:
        connection = self._clients.close(line)
        if connection is not None:
            self._step(Disconnected(connection))

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        connection = self._clients.number(line)
        if self._has_ended and request.kind != RELAY_REQUEST:
            ended = ResponseDetail.EXPERIMENT_ENDED
            line.answer(Response(int(ControlResponse.FAILURE), b"", HAS_ENDED, request.id, ended))
        elif connection is not None:
            self._step(RequestIn(connection, line.name, request), late=True)

    # --- as a client of the translator ---

    def line_up(self, line: ControlLine) -> None:
        self._step(TranslatorUp())

    def line_down(self, line: ControlLine) -> None:
        self._step(TranslatorDown())

    def answered(self, line: ControlLine, number: int, response: Response) -> None:
        self._step(TranslatorReply(number, Response(response.code, response.payload, response.reason, response.id)))

    # --- as a listener to the translator ---

    def since_ns(self, feed: Feed) -> int:
        return self.core.newest_source_ns

    def received(self, feed: Feed, packet: Packet) -> None:
        self._step(PacketIn(packet, self._header(packet)))

    def caught_up(self, feed: Feed) -> None:
        self._step(TranslatorCaughtUp())

    def killed(self, feed: Feed) -> None:
        """Do nothing: the translator sends no KILL."""

    # --- as a publisher ---

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        self._replay = ()
        self._step(ReplayRequested(feed, tuple(prefixes), since_ns))
        self._subscribers.join(feed)
        if self._has_ended:
            self.later(0.0, feed.kill_signal)  # after the replay: it is over
        return self._replay

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)

    # --- steps ---

    def reported(self, report: object) -> None:
        """Process a report of the coordinate frame's worker."""
        self._step(FrameReported(report))

    def _receive_reports(self, worker: FrameWorker) -> None:
        for report in worker.reports():
            self.reported(report)

    @property
    def _has_ended(self) -> bool:
        # after the end only supervisors' messages are processed
        return self.core.leave_at_s < math.inf

    def _step(self, event: Input, *, late: bool = False) -> None:
        if self._has_ended and not (late or isinstance(event, ReplayRequested)):
            return
        self._carry_out(event, self.core.step(event, self.timeline.monotonic_s(), self.timeline.now_ns()))

    def _carry_out(self, event: Input | None, effects: Sequence[Effect]) -> None:
        life = self.life
        for effect in effects:
            if self.dies_in_step and self.timeline.chance(self.dies_in_step):
                self.kill()
                return
            self._observer.carried_out(self, effect)
            self._do(effect)
            if life != self.life:
                return
        self._observer.stepped(self, event, effects)
        self._plan_tick()

    def _do(self, effect: Effect) -> None:
        if isinstance(effect, Reply):
            line = self._clients.line(effect.connection)
            if line is not None:
                line.answer(effect.response)
        elif isinstance(effect, Forward):
            self._link.ask(effect.request, effect.number)
        elif isinstance(effect, Publish):
            self.journal.before(effect)
            self._subscribers.publish(effect.packet)
            self.journal.after(effect)
        elif isinstance(effect, Delegate):
            if self.worker is not None:
                self.worker.take(effect.job)
                self.later(0.0, self._receive_reports, self.worker)
        elif isinstance(effect, Replay):
            self._replay = effect.packets
        elif isinstance(effect, SaveState):
            self.disk.save(effect.state)
        elif isinstance(effect, Kill):
            self._subscribers.kill_signal()

    def _plan_tick(self) -> None:
        self._ticking.set(self._wait_s())

    def _wait_s(self) -> float | None:
        if self._has_ended:
            return max(0.0, self.core.leave_at_s - self.timeline.monotonic_s())
        deadline_s, deadline_ns = self.core.deadline_s(), self.core.deadline_ns()
        waits = [] if deadline_s is None else [deadline_s - self.timeline.monotonic_s()]
        if deadline_ns is not None:
            waits.append(self.timeline.real_s((deadline_ns - self.timeline.now_ns()) / 1e9) + 1e-6)
        return min(waits, default=None)

    def _tick(self) -> None:
        if self.timeline.monotonic_s() >= self.core.leave_at_s:
            self.kill(80)
        else:
            self._step(Tick())
