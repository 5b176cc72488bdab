"""Simulated components: their behaviour is a generator, so that they wait without threads and can die at any point."""

from __future__ import annotations

from collections.abc import Callable, Generator
from typing import Any

from afspm.model import (
    ControlResponse,
    ControlState,
    Packet,
    Request,
    Response,
    ScopeState,
    ScopeStatus,
)
from afspm.model.events import SUPERVISOR, component_of
from afspm.testing.components.memory_network import ControlLine, Feed, Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_process import Process, ProcessTimer
from afspm.testing.components.simulated_time import SimulatedTime
from tests.simulation.codec import TableCodec

Doing = Generator[float, None, Any]
"""What a component does. It yields how long (real) it waits at most; it goes on when that is over or anything came."""

REQUEST_TIMEOUT_S = 6.0
TRIES = 4


class Client(Process):
    """A component. Subclasses write `behave`.

    Attributes:
        identity: its name for the scheduler; an impostor's differs from its `name`.
        knows_ids: it sends ids and repeats an unanswered request; a program without ids does neither.
        listens: the beginnings of the envelopes that it subscribes to.
        on_received: called with every packet that it receives.
    """

    knows_ids = True
    connects = True  # at its start
    listens: tuple[str, ...] = ("Scan2d", "ScopeStateMsg", "ControlState")

    def __init__(
        self,
        timeline: SimulatedTime,
        weather: Weather,
        codec: TableCodec,
        scheduler: SchedulerHost,
        name: str,
        identity: str | None = None,
    ) -> None:
        super().__init__(timeline, name)
        self.identity = identity or name
        self.cut_s = -1e9
        self.codec = codec
        self.on_received: Callable[[Client, Packet], None] = lambda client, packet: None
        self.on_answer: Callable[[Client, Request, Response], None] = lambda client, request, response: None
        self._weather = weather
        self._scheduler = scheduler
        self._forget()

    def _forget(self) -> None:
        self.control = ControlState()
        self.scope = ScopeState.UNDEFINED
        self.scans: list[Any] = []
        self.newest_ns = -1
        self.newest: dict[str, tuple[int, bytes | memoryview]] = {}
        self.over = False
        self._line: ControlLine | None = None
        self._feed: Feed | None = None
        self._doing: Doing | None = None
        self._alarm = ProcessTimer(self, self._go_on)
        self._requests = 0
        self._asked: Request | None = None
        self._answer: Response | None = None
        self._stepping = False

    # --- lives ---

    def begin(self) -> None:
        self._forget()
        if self.connects:
            self.connect()
        self._feed = Feed(self.timeline, self._weather, self, self._scheduler, self.listens)
        self._doing = self.behave()
        self.later(0.0, self._go_on)

    def connect(self) -> None:
        """Open the connection for requests."""
        self._line = ControlLine(self.timeline, self._weather, self, self._scheduler, self.identity)
        self._line.owner = component_of(self.identity if self.identity.startswith(SUPERVISOR) else self.name)

    def ended(self) -> None:
        if self._line is not None:
            self._line.close()
        if self._feed is not None:
            self._feed.close()
        if self._doing is not None and not self._stepping:
            self._doing.close()
        self._doing = None

    def cut(self) -> None:
        """Break its connections, which are then reopened."""
        self.cut_s = self.timeline.monotonic_s()
        if self._line is not None:
            self._line.cut()
        if self._feed is not None:
            self._feed.cut()

    def fall_silent(self, for_s: float) -> None:
        """Let its connections lose all messages for a time before they break."""
        self.cut_s = self.timeline.monotonic_s() + for_s
        for connection in (self._line, self._feed):
            if connection is not None:
                connection.fall_silent(for_s)

    def behave(self) -> Doing:
        """Run the component from its start on."""
        raise NotImplementedError

    def _go_on(self) -> None:
        doing = self._doing
        if doing is None or self._stepping:
            return
        self._stepping = True
        try:
            wait_s = next(doing)
        except StopIteration:
            self._doing = None
            if self.alive:
                self.kill(0)
            return
        finally:
            self._stepping = False
        if self._doing is doing:
            self._alarm.set(wait_s)

    # --- what comes ---

    def line_up(self, line: ControlLine) -> None:
        self._go_on()

    def line_down(self, line: ControlLine) -> None:
        self._go_on()

    def answered(self, line: ControlLine, number: int, response: Response) -> None:
        asked = self._asked
        if asked is not None and self._answer is None and (response.id == asked.id or not self.knows_ids):
            self._answer = response
            self.on_answer(self, asked, response)
            self._go_on()

    def since_ns(self, feed: Feed) -> int:
        return self.newest_ns

    def received(self, feed: Feed, packet: Packet) -> None:
        assert packet.time_ns is not None
        envelope, time_ns, payload = packet.envelope, packet.time_ns, packet.payload
        known = self.newest.get(envelope)
        if known is not None and time_ns <= known[0]:
            return  # as our subscribers do
        self.on_received(self, packet)
        self.newest[envelope] = (time_ns, payload)
        if time_ns > self.newest_ns:
            self.newest_ns = time_ns
        thing = self.codec.decode(payload)
        if isinstance(thing, ControlState):
            self.control = thing
        elif isinstance(thing, ScopeStatus):
            self.scope = thing.state
        elif envelope.startswith("Scan2d"):
            self.scans.append(thing)
        self._go_on()

    def caught_up(self, feed: Feed) -> None:
        """Note that the replay of the cache is complete."""

    def killed(self, feed: Feed) -> None:
        self.kill(80)

    # --- what behaviours are made of ---

    def ask(self, kind: int, subject: Any = None, key: str = "") -> Generator[float, None, Response]:
        """Send a request, again if there is no answer; NO_RESPONSE if there never is."""
        request = self._request(kind, subject, key)
        for _ in range(TRIES if self.knows_ids else 1):
            yield from self.until(lambda: self._line is not None and self._line.up)
            self._asked, self._answer = request, None
            if self._line is not None:
                self._line.ask(request)
            yield from self.until(lambda: self._answer is not None, REQUEST_TIMEOUT_S)
            if self._answer is not None:
                break
        answer, self._asked, self._answer = self._answer, None, None
        return answer or Response(int(ControlResponse.NO_RESPONSE), b"", "silence", request.id)

    def tell(self, kind: int, subject: Any = None) -> None:
        """Send a request without waiting for its answer."""
        if self._line is not None and self._line.up:
            self._line.ask(self._request(kind, subject))

    def _request(self, kind: int, subject: Any, key: str = "") -> Request:
        self._requests += 1
        request_id = key or f"{self.identity}/{self.name}-{self.life}/{self._requests}"
        return Request(int(kind), subject, self.codec.encode(subject), request_id if self.knows_ids else "")

    def until(self, holds: Callable[[], bool], timeout_s: float = 1e9) -> Generator[float, None, bool]:
        """Wait for a condition; False after the timeout."""
        end_s = self.timeline.monotonic_s() + timeout_s
        while not holds():
            left_s = end_s - self.timeline.monotonic_s()
            if left_s <= 1e-9:
                return False
            yield left_s
        return True

    def sleep(self, real_s: float) -> Generator[float, None, None]:
        yield from self.until(lambda: False, real_s)

    def some(self, experiment_s: float) -> float:
        """Return a random real time of the order of `experiment_s` in the experiment's time."""
        return self.timeline.real_s(experiment_s * (0.2 + 1.6 * self.timeline.random.random()))
