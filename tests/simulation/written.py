"""The scheduler's event log, compared with the observed events."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from afspm.model import (
    ControlEvent,
    ControlMode,
    ControlRequest,
    ControlResponse,
    JournalEntries,
    JournalEntry,
    Packet,
    ProblemNames,
    Request,
    component_of,
    names,
)
from afspm.model.events import SUPERVISOR
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.events import Effect, Input, Publish, Reply
from afspm.scheduler.publishing.event_log import CONTROL, PERIOD_S, SCHEDULER
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_time import SimulatedTime
from afspm.wire.messages import JOURNAL
from tests.simulation.codec import TableCodec

_NO_RESPONSE, _SUCCESS = int(ControlResponse.NO_RESPONSE), int(ControlResponse.SUCCESS)
_STARTS = (names.START_SCAN, names.START_SPEC)
_UNREADABLE = "an unreadable request"
_ALIKE = ("old", "burster")
"""Components that send equal requests in one moment."""
_REMEMBERED = 5000
_LATE_S = 0.5
_CATCHING_UP_S = 10.0
"""After a restart what was published before may come again for so long; nothing is written down until then."""

Told = tuple[str, int, int]
"""Who was answered, with which response, when (experiment, ns)."""


@dataclass
class _Derived:
    """The state of control as derived from the entries."""

    holder: str | None = None
    mode: str = ControlMode.AUTOMATED.name
    problems: dict[int, str] = field(default_factory=dict)

    @classmethod
    def of(cls, control: ArbitrationState) -> _Derived:
        return cls(control.holder, control.mode.name, dict(control.problems))

    def take(self, entry: JournalEntry) -> None:
        match entry.event:
            case ControlEvent.CONTROL_LOST:
                self.holder = None
            case ControlEvent.CONTROL_GAINED:
                self.holder = entry.who
            case ControlEvent.MODE_CHANGED if entry.mode is not None:
                self.mode = entry.mode.name
            case ControlEvent.PROBLEM_FLAGGED if entry.problem is not None:
                self.problems[entry.problem] = entry.who
            case ControlEvent.PROBLEM_CLEARED if entry.problem is not None:
                self.problems.pop(entry.problem, None)


_ANSWERED_S = 15.0
"""After so long (real) at the latest a start has its answer, or is known to have none, and its entry is published."""


class Written:
    """Every answer is logged once, soon and in order, and published entries outlive a kill.

    Args:
        must: raises a violation if a condition does not hold.
        of_the_sender: parts of refusals of a client, which are sent each time.
    """

    def __init__(
        self,
        timeline: SimulatedTime,
        codec: TableCodec,
        must: Callable[[bool, str], None],
        of_the_sender: tuple[str, ...],
    ) -> None:
        self._timeline = timeline
        self._codec = codec
        self._must = must
        self._of_the_sender = of_the_sender
        self._names = ProblemNames()
        self._life = 0
        self._answered: set[tuple[str, str]] = set()
        self._awaited: deque[tuple[float, Told]] = deque()
        self._spare: Counter[tuple[str, int]] = Counter()  # written down, but nobody has seen the reply: (who, code)
        self._seen: set[JournalEntry] = set()
        self._order: deque[JournalEntry] = deque()
        self._newest_ns = 0
        self._published_s = -1.0
        self._newest: Packet | None = None
        self._derived = _Derived()
        self.entries = 0
        self.is_certain = True
        self._started: dict[str, dict[str, float]] = {}
        self._starts: dict[str, set[int]] = {}

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        """Check an effect before it is carried out."""
        if host.life != self._life:
            self._begin(host)
        if isinstance(effect, Reply):
            self._reply(effect)
        elif isinstance(effect, Publish) and effect.packet.envelope == JOURNAL.name:
            self._publish(effect.packet, at_the_end=host.core.control.ended)

    def executed(self, request: Request) -> None:
        """Note a command that the microscope executes."""
        if request.id and request.kind == ControlRequest.ACTION and request.subject in _STARTS:
            begun = self._started.setdefault(request.id.partition("/")[0], {})
            begun.setdefault(request.id, self._timeline.monotonic_s())

    def has_all_starts(self) -> None:
        """Check that each measurement that was begun has the entry of its start, also after a kill in between."""
        answered_s = self._timeline.monotonic_s() - _ANSWERED_S
        for who, times_s in self._started.items():
            begun = sum(begun_s <= answered_s for begun_s in times_s.values())
            written = len(self._starts.get(who, ()))
            self._must(written >= begun or not self.is_certain, f"{who}: {begun} begun, {written} written")

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Check the entries after a step."""
        if host.life != self._life:
            self._begin(host)
        if any(isinstance(effect, Publish) and effect.packet.envelope == JOURNAL.name for effect in effects):
            is_so = _Derived.of(host.core.control)
            self._must(self._derived == is_so, f"by what is written {self._derived}, in truth {is_so}")
        now_s = self._timeline.monotonic_s()
        if self._awaited:
            since_s = max(self._awaited[0][0], host.since_s + _CATCHING_UP_S)
            self._must(now_s - since_s <= PERIOD_S + _LATE_S, f"not written down: {self._awaited[0]}")

    def _begin(self, host: SchedulerHost) -> None:
        # a kill loses entries that were not published, and no others
        self._life = host.life
        before_ns = -1 if self._newest is None else self._newest.time_ns or 0
        for packet, *_ in host.core.cached():
            # written, but not published: the life before died in between. A recorder reads it from the disk
            if packet.envelope == JOURNAL.name and (packet.time_ns or 0) > before_ns:
                self._newest = packet
                for entry in self._codec.decode(packet.payload).entries:
                    self._count(entry)
                    self._remember(entry)
        self._answered.clear()
        self._awaited.clear()
        self._spare.clear()
        self._derived = _Derived.of(host.core.control)
        self._published_s = -1.0
        if self._newest is not None and self.is_certain:
            kept = [packet for packet, *_ in host.core.cached() if packet.time_ns == self._newest.time_ns]
            self._must(kept == [self._newest], "what was written last is not there any more after a restart")

    def _reply(self, reply: Reply) -> None:
        response = reply.response
        key = (reply.name, response.id)
        if component_of(reply.name) == SUPERVISOR:
            return  # what it tells is published, and not that it did
        is_of_the_sender = any(why in response.reason for why in self._of_the_sender)
        anew = not response.id or response.code == _NO_RESPONSE or is_of_the_sender
        if not anew and key not in self._answered and self._spare[reply.name, response.code]:
            self._spare[reply.name, response.code] -= 1  # written down when there was nobody to be told
        elif anew or key not in self._answered:
            told = (reply.name, response.code, self._timeline.now_ns())
            self._awaited.append((self._timeline.monotonic_s(), told))
        if not anew:
            self._answered.add(key)

    def _publish(self, packet: Packet, *, at_the_end: bool) -> None:
        entries = self._codec.decode(packet.payload)
        assert isinstance(entries, JournalEntries)
        now_s = self._timeline.monotonic_s()
        self._must(bool(entries.entries), "nothing is published as if something had happened")
        is_soon = now_s - self._published_s < PERIOD_S - 1e-9
        self._must(at_the_end or not is_soon, "entries are published too often")
        self._published_s, self._newest = now_s, packet
        told = [told for _, told in self._awaited]
        for entry in entries.entries:
            self._take(entry, told)
        for who, code, _ in told:  # the same, a moment ago
            self._must(self._spare[who, code] > 0, f"answered and not written down: {who}, {code}")
            self._spare[who, code] -= 1
        self._awaited.clear()

    def _take(self, entry: JournalEntry, told: list[Told]) -> None:
        self._count(entry)
        self._must(entry.time_ns >= self._newest_ns, f"written down out of order: {entry}")
        self._newest_ns = entry.time_ns
        if entry.kind == CONTROL:
            # acts at the panel during an outage come in one moment
            self._must(entry not in self._seen or entry.event is ControlEvent.BY_HAND, f"written down twice: {entry}")
            self._derived.take(entry)
        one = (entry.who, entry.response or 0, entry.time_ns)
        if entry.response is not None and one in told:
            told.remove(one)
        elif entry.response is not None and entry.who != SCHEDULER:
            # its answer could not be delivered, or came late: then it is written down, but nobody has seen a reply
            # several unreadable requests of a moment look the same
            twice = entry in self._seen and entry.what != _UNREADABLE and entry.who not in _ALIKE
            self._must(not twice, f"written down twice: {entry}")
            self._spare[one[:2]] += 1
        self._remember(entry)

    def _count(self, entry: JournalEntry) -> None:
        self.entries += 1
        if entry.sent_ns is not None and entry.what in _STARTS and entry.response in (_SUCCESS, _NO_RESPONSE):
            self._starts.setdefault(entry.who, set()).add(entry.sent_ns)

    def _remember(self, entry: JournalEntry) -> None:
        self._seen.add(entry)
        self._order.append(entry)
        if len(self._order) > _REMEMBERED:
            self._seen.discard(self._order.popleft())
