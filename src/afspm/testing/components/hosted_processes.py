"""Real components and the real translator as simulated processes, with in-memory ports and a folder for a disk.

`ComponentProcess` runs a `Component` as `afspm.supervisor.host` does; `TranslatorProcess` runs a `Driver` behind the
real `Translator`. Both use the real wire format.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from afspm import wire
from afspm.basics.launch import Launch, Sockets
from afspm.client.component import Component
from afspm.model import Packet, Request, Response
from afspm.storage.memory import Memory
from afspm.testing.components.baton import Baton
from afspm.testing.components.memory_network import ControlLine, Feed, PacketSource, Subscribers, Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_process import Process
from afspm.testing.components.simulated_time import SimulatedTime, Timer
from afspm.translator.driver import Driver
from afspm.translator.translator import Translator, TranslatorRun
from afspm.transport.late_joiners import PublishedHistory
from afspm.transport.port import (
    CaughtUp,
    ControlConnected,
    ControlDisconnected,
    Incoming,
    Killed,
    PacketReceived,
    ReplyReceived,
    RequestReceived,
    Served,
    SubscriberJoined,
)
from afspm.transport.process.context import ProcessActivity, ProcessContext

SOURCE = "memory://scheduler"


class BlockingProcess(Process):
    """A process with blocking code.

    Args:
        dies_in_call: the chance of a kill in a call to its port, before or after the call has its effect.

    Attributes:
        ended_with: the last end of the code by itself: an exit code or an exception; None without one.
        wait_s: duration of the last wait with a time limit.
    """

    def __init__(self, timeline: SimulatedTime, name: str, *, dies_in_call: float = 0.0) -> None:
        super().__init__(timeline, name)
        self.wait_s = 0.0
        self.dies_in_call = dies_in_call
        self.ended_with: int | BaseException | None = None
        self._baton: Baton | None = None
        self._waiting_for: Timer | None = None
        self._waits = False

    # --- the simulation's side ---

    def begin(self) -> None:
        self.connect()
        self._baton = Baton(self.name, self.body)
        self.later(0.0, self._go_on)

    def ended(self) -> None:
        self.disconnect()
        self._forget_timer()
        baton, self._baton = self._baton, None
        if baton is not None and not baton.over:
            baton.kill()

    def abandon(self) -> None:
        """End the process's thread, at the end of the simulation."""
        if self._baton is not None:
            self._baton.abandon()

    def arrived(self) -> None:
        """Wake the process's code if it waits for a message."""
        if self._waits:
            self._go_on()

    def timed_out(self) -> None:
        """Wake the process's code at the end of its wait."""
        self._go_on()

    def wait_again(self, timeout_s: float) -> None:
        """Let the wait of the process's code end in `timeout_s`."""
        self.wait_s = timeout_s
        self._waiting_for = self.later(timeout_s, self.timed_out)

    def _go_on(self) -> None:
        self._forget_timer()
        baton, life = self._baton, self.life
        if baton is None:
            return
        baton.go_on()
        if baton.over and life == self.life:
            self.ended_with = baton.error if baton.error is not None else baton.code
            died = baton.error is not None or baton.code is None
            self.kill(1 if died else int(baton.code or 0))

    def _forget_timer(self) -> None:
        self._waits = False
        if self._waiting_for is not None:
            self._waiting_for.cancel()
            self._waiting_for = None

    # --- the code's side ---

    def wait(self, timeout_s: float | None) -> None:
        """Wait for `arrived`, up to `timeout_s`."""
        assert self._baton is not None
        self._waits = True
        if timeout_s is not None:
            self.wait_again(timeout_s)
        self._baton.wait()

    def may_die(self) -> None:
        """Kill the process now, with probability `dies_in_call`."""
        if self.dies_in_call and self.timeline.chance(self.dies_in_call):
            assert self._baton is not None
            self._baton.die()

    # --- for subclasses ---

    def body(self) -> int:
        """Run the process; return its exit code."""
        raise NotImplementedError

    def connect(self) -> None:
        """Open the connections of a new life."""

    def disconnect(self) -> None:
        """Close the connections of the life that has ended."""


class ComponentProcess(BlockingProcess):
    """A simulated process that runs a `Component` with an in-memory port.

    Args:
        make: creates the component for each life.
        folder: state_dir and run_dir of the component.
        launch: the component's launch line, without sockets and folders.

    Attributes:
        publishers: other components whose packets the component receives directly.
        published: called with each packet of the component.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        scheduler: SchedulerHost,
        name: str,
        make: Callable[[], Component],
        folder: Path,
        *,
        dies_in_call: float = 0.0,
        launch: Launch | None = None,
    ) -> None:
        super().__init__(timeline, name, dies_in_call=dies_in_call)
        self._launch = launch or Launch(name)
        self.publishers: list[ComponentProcess] = []
        self.published: Callable[[Packet], None] = lambda packet: None
        self._weather = weather
        self._scheduler = scheduler
        self._make = make
        self._folder = folder
        self._inbox: list[Incoming] = []
        self._newest: dict[str, dict[str, int]] = {}
        self._feeds: dict[Feed, str] = {}

    def connect(self) -> None:
        self._inbox = []
        self._newest = {}
        self._published = PublishedHistory(self.timeline)
        self._subscribers = Subscribers()
        self._line = ControlLine(self.timeline, self._weather, self, self._scheduler, self.name)
        wanted = self._launch.envelopes
        envelopes = wire.messages_of_the_experiment() if wanted is None else wanted
        prefixes = sorted({*envelopes, *wire.followed_messages()})
        sources: dict[str, PacketSource] = {
            SOURCE: self._scheduler,
            **{f"memory://{one.name}": one for one in self.publishers},
        }
        self._feeds = {
            Feed(self.timeline, self._weather, self, publisher, prefixes): source
            for source, publisher in sources.items()
        }

    def disconnect(self) -> None:
        self._line.close()
        for feed in self._feeds:
            feed.close()

    def body(self) -> int:
        launch = replace(
            self._launch,
            sockets=Sockets(publish=f"memory://{self.name}", subscribe=tuple(self._feeds.values())),
            state_dir=str(self._folder),
            run_dir=str(self._folder),
            simulated=True,
        )
        context = ProcessContext(
            launch,
            self.timeline,
            open_port=lambda: MemoryPort(self),
            log=logging.getLogger(f"afspm.{self.name}"),
            activity=ProcessActivity(self.timeline),
            session=f"life{self.life}",
        )
        return self._make().run_process(context)

    def cut(self, for_s: float = 0.0) -> None:
        """Break the connections, and restore them after about `for_s`."""
        self._weather.reconnect_s, before_s = max(for_s, self._weather.reconnect_s), self._weather.reconnect_s
        self._line.cut()
        for feed in self._feeds:
            feed.cut()
        self._weather.reconnect_s = before_s

    # --- what comes ---

    def line_up(self, line: ControlLine) -> None:
        self._put(ControlConnected())

    def line_down(self, line: ControlLine) -> None:
        self._put(ControlDisconnected())

    def answered(self, line: ControlLine, number: int, response: Response) -> None:
        self._put(ReplyReceived(wire.decode_response(wire.encode_response(response))))

    def since_ns(self, feed: Feed) -> int:
        return max(self._newest_from(feed).values(), default=-1)

    def received(self, feed: Feed, packet: Packet) -> None:
        time_ns, newest = packet.time_ns or 0, self._newest_from(feed)
        if time_ns > newest.get(packet.envelope, -1):
            newest[packet.envelope] = time_ns
            self._put(PacketReceived(packet, self._feeds[feed]))

    def _newest_from(self, feed: Feed) -> dict[str, int]:
        return self._newest.setdefault(self._feeds.get(feed, ""), {})

    def caught_up(self, feed: Feed) -> None:
        self._put(CaughtUp(self._feeds[feed]))

    def killed(self, feed: Feed) -> None:
        self._put(Killed())

    def _put(self, incoming: Incoming) -> None:
        self._inbox.append(incoming)
        self.arrived()

    # --- as a publisher ---

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        self._subscribers.join(feed)
        return self._published(feed, tuple(prefixes), since_ns)

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)

    # --- what its port does ---

    def publish(self, envelope: str, payload: bytes) -> None:
        self.may_die()
        packet = self._published.stamp(envelope, payload)
        self.published(packet)
        self._subscribers.publish(packet)

    def send(self, frames: Sequence[bytes]) -> None:
        self.may_die()
        self._line.ask(wire.decode_request(frames))
        self.may_die()

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        if not self._inbox and timeout_s != 0.0:
            self.wait(timeout_s)
        self.may_die()
        came, self._inbox = self._inbox, []
        return came

    def request_since(self, since_ns: int) -> None:
        for feed in self._feeds:
            feed.request_since(since_ns)

    def wake(self, incoming: Incoming | None) -> None:
        if incoming is not None:
            self._inbox.append(incoming)


class MemoryPort:
    """The in-memory form of `afspm.transport.port.Port`."""

    def __init__(self, host: ComponentProcess) -> None:
        self._host = host

    @property
    def clock(self) -> SimulatedTime:
        return self._host.timeline

    def send(self, frames: Sequence[bytes]) -> None:
        self._host.send(frames)

    def poll(self, timeout_s: float | None) -> list[Incoming]:
        return self._host.poll(timeout_s)

    def publish(self, envelope: str, payload: bytes) -> None:
        self._host.publish(envelope, payload)

    def request_since(self, since_ns: int) -> None:
        self._host.request_since(since_ns)

    def wake_up(self, incoming: Incoming | None = None) -> None:
        self._host.wake(incoming)

    def wakeup_fileno(self) -> int:
        return -1

    def close(self) -> None:
        """Do nothing: the process owns the connections."""


class TranslatorProcess(BlockingProcess):
    """A simulated process that runs a `Driver` behind the real `Translator`.

    Args:
        make: creates the driver for each life.
        folder: folder for the translator's memory, and its run folder.

    Attributes:
        translator, memory: of the present life, once its code runs.
    """

    translator: Translator
    memory: Memory

    def __init__(
        self,
        timeline: SimulatedTime,
        make: Callable[[], Driver],
        folder: Path,
        *,
        dies_in_call: float = 0.0,
    ) -> None:
        super().__init__(timeline, "translator", dies_in_call=dies_in_call)
        self._make = make
        self._folder = folder

    def connect(self) -> None:
        self._published = PublishedHistory(self.timeline)
        self._subscribers = Subscribers()
        self._inbox: deque[Served | tuple[ControlLine, Request, int]] = deque()
        self._answering: tuple[ControlLine, int] | None = None

    def body(self) -> int:
        self.memory = memory = Memory(self._folder / "translator.json")
        log, run = logging.getLogger("afspm.translator"), TranslatorRun(self._folder)
        self.translator = translator = Translator(self._make(), MemoryServerPort(self), memory, run, log)
        try:
            return translator.run()
        finally:
            memory.close()

    # --- what comes ---

    def peer_connected(self, line: ControlLine) -> None:
        """Do nothing until the first request."""

    def peer_disconnected(self, line: ControlLine) -> None:
        """Do nothing: the answer is lost with the connection."""

    def peer_asked(self, line: ControlLine, request: Request, number: int) -> None:
        self._inbox.append((line, request, number))
        self.arrived()

    def joined(self, feed: Feed, prefixes: Sequence[str], since_ns: int) -> Sequence[Packet]:
        self._subscribers.join(feed)
        self._inbox.append(SubscriberJoined())
        self.later(0.0, self.arrived)
        return self._published(feed, tuple(prefixes), since_ns)

    def left(self, feed: Feed) -> None:
        self._subscribers.leave(feed)

    # --- what its port does ---

    def poll(self, timeout_s: float | None) -> list[Served]:
        if not self._inbox and timeout_s != 0.0:
            self.wait(timeout_s)
        self.may_die()
        if not self._inbox:
            return []
        came = self._inbox.popleft()
        if not isinstance(came, tuple):
            return [came]
        line, request, number = came
        self._answering = (line, number)
        return [RequestReceived(wire.encode_request(request))]

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self.may_die()
        answering, self._answering = self._answering, None
        if answering is not None and frames is not None:
            line, number = answering
            line.answer(wire.decode_response(frames), number)
        self.may_die()

    def publish(self, envelope: str, payload: bytes, time_ns: int | None, *, keep: bool) -> None:
        self.may_die()
        packet = self._published.stamp(envelope, payload, time_ns, keep=keep)
        self._subscribers.publish(packet)

    def wake(self, incoming: Served | None) -> None:
        if incoming is not None:
            self._inbox.append(incoming)


class MemoryServerPort:
    """The in-memory form of `afspm.transport.port.ServerPort`."""

    def __init__(self, host: TranslatorProcess) -> None:
        self._host = host

    @property
    def clock(self) -> SimulatedTime:
        return self._host.timeline

    def poll(self, timeout_s: float | None) -> list[Served]:
        return self._host.poll(timeout_s)

    def waiting_request(self) -> None:
        """Return None: no question to a simulated controller takes time."""

    def reply(self, frames: Sequence[bytes] | None) -> None:
        self._host.reply(frames)

    def is_connected(self, connection: bytes) -> bool:
        """Return True: the simulated scheduler has no epoch, so the result is not used."""
        return True

    def publish(self, envelope: str, payload: bytes, time_ns: int | None = None, *, keep: bool = True) -> None:
        self._host.publish(envelope, payload, time_ns, keep=keep)

    def wake_up(self, incoming: Served | None = None) -> None:
        self._host.wake(incoming)

    def close(self) -> None:
        """Do nothing: the process owns the connections."""
