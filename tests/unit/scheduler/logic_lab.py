"""A scheduler's core without sockets, with short calls for tests."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from tests.simulation.codec import TableCodec

from afspm.model import (
    RELAY_REQUEST,
    ControlMode,
    ControlRequest,
    ControlResponse,
    JournalEntry,
    LoggedPacket,
    Packet,
    PacketHeader,
    Parameter,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    RelayedMessage,
    Request,
    Response,
    ResponseDetail,
    ScopeState,
    ScopeStatus,
)
from afspm.model.parameter_names import BASE_PARAMETERS
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.events import (
    Connected,
    Disconnected,
    Effect,
    Forward,
    Input,
    PacketIn,
    Publish,
    Reply,
    RequestIn,
    SaveState,
    Tick,
    TranslatorCaughtUp,
    TranslatorReply,
    TranslatorUp,
)
from afspm.scheduler.publishing.event_log import PERIOD_S
from afspm.scheduler.safety.limit_checker import is_get
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.settings import SchedulerSettings

NS = 10**9


class Lab:
    """A core with its effects so far, and short calls for events. A name gets a connection with its first request."""

    def __init__(
        self,
        settings: SchedulerSettings | None = None,
        *,
        state: SavedState | None = None,
        codec: TableCodec | None = None,
        packets: Sequence[LoggedPacket] = (),
        now: tuple[float, int] = (100.0, 1_750_000_000 * NS),
    ) -> None:
        self.codec = codec or TableCodec()
        self.core = SchedulerCore(settings or SchedulerSettings(), self.codec)
        self.now_s, self.now_ns = now
        self.connections: dict[str, int] = {}
        self.effects: list[Effect] = []
        self.forwarded: list[Forward] = []
        self.newest = 0
        self.entries_seen = 0
        if state is not None:
            self.core.restore(as_saved(state))
            self.core.restore_cache(packets)
        self.effects += self.core.start(self.now_s, self.now_ns)

    def step(self, event: Input) -> list[Effect]:
        effects = self.core.step(event, self.now_s, self.now_ns)
        self.effects += effects
        self.forwarded += [effect for effect in effects if isinstance(effect, Forward)]
        return effects

    def later(self, real_s: float = 0.0, experiment_s: float = 0.0) -> None:
        self.now_s += real_s
        self.now_ns += round(experiment_s * NS)

    def entries(self) -> list[JournalEntry]:
        """Wait for the next publication of entries; return the entries since the last call."""
        self.later(PERIOD_S)
        self.step(Tick())
        told = [self.codec.decode(p.payload) for p in published(self.effects) if p.envelope == "JournalEntries"]
        new, self.entries_seen = told[self.entries_seen :], len(told)
        return [entry for entries in new for entry in entries.entries]

    def connect(self, name: str) -> int:
        self.newest += 1
        self.connections[name] = self.newest
        self.step(Connected(self.newest))
        return self.newest

    def translator(self, retracts: ControlResponse = ControlResponse.SUCCESS) -> None:
        """Connect a translator that answers the scheduler's question whether it retracts."""
        self.step(TranslatorUp())
        self.step(TranslatorCaughtUp())
        question = next(one for one in self.forwarded if one.request.kind == ControlRequest.ACTION_SUPPORT)
        self.forwarded.remove(question)
        self.answer(question, retracts)

    def answer(
        self,
        forward: Forward,
        code: ControlResponse = ControlResponse.SUCCESS,
        payload: bytes = b"",
        reason: str = "",
        detail: ResponseDetail = ResponseDetail.NONE,
    ) -> list[Effect]:
        response = Response(int(code), payload, reason, forward.request.id, detail)
        return self.step(TranslatorReply(forward.number, response))

    def answer_reads(
        self, lacking: ControlResponse = ControlResponse.PARAM_NOT_SUPPORTED, **values: str
    ) -> list[Effect]:
        """Answer reads, in SI, until another request is sent.

        Args:
            lacking: the answer for a parameter that the microscope does not have.
            values: by name, with underscores; the microscope has no others.
        """
        effects: list[Effect] = []
        while (asked := self.in_flight()) is not None and is_get(asked.request):
            name = asked.request.subject.name
            value = values.get(name.replace("-", "_"))
            payload = b"" if value is None else self.codec.encode(Parameter(name, value, BASE_PARAMETERS.get(name)))
            code = lacking if value is None else ControlResponse.SUCCESS
            effects = self.answer(asked, code, payload)
        return effects

    def in_flight(self) -> Forward | None:
        """Return the request that the translator has not answered yet."""
        flight = self.core.state.forwarder.flight
        return None if flight is None else next(one for one in self.forwarded if one.number == flight.number)

    def ask(self, name: str, kind: int, subject: Any = None, id_: str = "", user: str | None = None) -> list[Effect]:
        connection = self.connections.get(name) or self.connect(name)
        payload = b"" if subject is None else self.codec.encode(subject)
        return self.step(RequestIn(connection, name, Request(int(kind), subject, payload, id_), user))

    def says(self, name: str, kind: int, subject: Any = None, id_: str = "") -> ControlResponse:
        """Send a request, and return the code of its immediate answer."""
        return ControlResponse(replies(self.ask(name, kind, subject, id_))[-1].response.code)

    def take_control(self, name: str, problem: int = 0) -> ControlResponse:
        return self.says(name, ControlRequest.REQUEST_CTRL, problem)

    def flag(self, name: str, problem: int) -> ControlResponse:
        return self.says(name, ControlRequest.ADD_EXP_PRBLM, problem)

    def clear(self, name: str, problem: int) -> ControlResponse:
        return self.says(name, ControlRequest.RMV_EXP_PRBLM, problem)

    def mode(self, name: str, mode: ControlMode) -> ControlResponse:
        return self.says(name, ControlRequest.SET_CONTROL_MODE, int(mode))

    def publish(self, message: str, thing: Any, time_ns: int | None = None) -> list[Effect]:
        self.now_ns += 1000
        packet = Packet(message, self.codec.encode(thing), self.now_ns if time_ns is None else time_ns)
        return self.step(PacketIn(packet, PacketHeader(message)))

    def scope_is(self, state: ScopeState) -> list[Effect]:
        return self.publish("ScopeStateMsg", ScopeStatus(state))

    def is_gone(self, name: str) -> None:
        """Disconnect a component."""
        if (connection := self.connections.pop(name, None)) is not None:
            self.step(Disconnected(connection))

    def tell(self, *states: ProcessState, supervisor: str = "supervisor:lab") -> list[Effect]:
        """Report process states as a supervisor, then process the due deadlines."""
        thing = ProcessStates(self.now_ns, supervisor.partition(":")[2], states)
        self.ask(supervisor, RELAY_REQUEST, RelayedMessage("ProcessStates", self.codec.encode(thing)))
        return self.step(Tick())

    def give_up(self, name: str) -> list[Effect]:
        """Let the process of a component die without a restart."""
        self.is_gone(name)
        return self.tell(ProcessState(name, "component", ProcessCondition.GIVEN_UP, 1))

    @property
    def holder(self) -> str | None:
        return self.core.control.holder


def as_saved(state: SavedState) -> SavedState:
    """Return the state as read back from a file."""
    return restored(SavedState, json.loads(json.dumps(snapshot(state, KIND, VERSION))), KIND, VERSION)


def replies(effects: list[Effect]) -> list[Reply]:
    return [effect for effect in effects if isinstance(effect, Reply)]


def published(effects: list[Effect]) -> list[Packet]:
    return [effect.packet for effect in effects if isinstance(effect, Publish)]


def kinds(effects: list[Effect]) -> list[str]:
    return [type(effect).__name__ for effect in effects]


def in_control(settings: SchedulerSettings) -> Lab:
    lab = Lab(settings)
    lab.translator()
    lab.take_control("experiment")
    return lab


def killed(lab: Lab, settings: SchedulerSettings) -> Lab:
    """Return a scheduler restarted with the state saved last."""
    saved = [effect.state for effect in lab.effects if isinstance(effect, SaveState)][-1]
    again = Lab(settings, state=saved, codec=lab.codec)
    again.now_s, again.now_ns = lab.now_s, lab.now_ns
    again.translator()
    return again


def resumed(lab: Lab, settings: SchedulerSettings) -> Lab:
    """Return a restarted scheduler that has received the translator's missed packets."""
    again = killed(lab, settings)
    for _ in range(3):  # one decision in each
        again.later(real_s=settings.waits.catch_up_s)
        again.step(Tick())
    return again
