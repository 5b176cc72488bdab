"""The invariants after every step, checked from outside and by other means than the decisions themselves."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence

from afspm.basics.errors import AfspmError
from afspm.model import (
    ActByHand,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Packet,
    PanelAct,
    Parameter,
    Request,
    Response,
    ScopeState,
    TipStatus,
    names,
)
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.control.holder_timeout import MOST_RESTARTS
from afspm.scheduler.events import (
    Disconnected,
    Effect,
    Forward,
    Input,
    PacketIn,
    Publish,
    Replay,
    ReplayRequested,
    Reply,
    RequestIn,
    SaveState,
)
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.settings import SchedulerSettings
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_time import SimulatedTime
from tests.simulation.client import Client
from tests.simulation.codec import TableCodec
from tests.simulation.microscope import GARBLED, FakeMicroscope
from tests.simulation.panel import PAUSING
from tests.simulation.tip_safety import TipSafety
from tests.simulation.within_limits import WithinLimits
from tests.simulation.written import Written

_SUCCESS, _NO_RESPONSE = int(ControlResponse.SUCCESS), int(ControlResponse.NO_RESPONSE)
_FORWARDED = range(int(ControlRequest.ACTION), int(ControlRequest.SET_PROBE_POS) + 1)
_NOT_FREE = int(ControlResponse.NOT_FREE)
_COUNTED = frozenset({names.START_SCAN, names.START_SPEC, names.PULSE})
_TRACE = 60
_SLACK_S = 1.0
OF_THE_SENDER = ("each needs a name of its own", "this is the key of")
"""Parts of refusals that are answers to the sender, and not to the request."""


class InvariantViolated(AfspmError):
    """An invariant does not hold."""

    code = "invariant"


class Invariants:
    """Observes the scheduler, the microscope and all components of one simulated night.

    Attributes:
        has_keys: see `Plan.keys`.
        panel_is_manned: whether a person acts at the panel of the microscope.
        handed_over: whether the microscope belongs to that person now.
        acts: how many acts gave the microscope to that person.
    """

    def __init__(
        self, timeline: SimulatedTime, settings: SchedulerSettings, microscope: FakeMicroscope, codec: TableCodec
    ) -> None:
        self._timeline = timeline
        self._settings = settings
        self.tip = TipSafety(timeline, settings, microscope, self._must)
        self.limits = WithinLimits(timeline, settings, microscope, self._must)
        self._microscope = microscope
        self._scheduler_since_s = 0.0
        self.components: list[Client] = []
        self.checks = 0
        self._trace: deque[tuple[float, Input | None, tuple[Effect, ...]]] = deque(maxlen=_TRACE)
        self._holder: str | None = None
        self._held_since_s = 0.0
        self._absent_since_s: dict[str, float | None] = {}
        self._tenure: tuple[str | None, int, int] = (None, 0, 0)
        self._restarts = 0
        self._idle_since_ns: int | None = None
        self._used_ns = 0
        self._last_ns = -1
        self._published: dict[int, tuple[str, bytes | memoryview]] = {}
        self._by_source: dict[int, int] = {}
        self._actions: dict[tuple[str, str], str] = {}
        self._parameters: dict[tuple[str, str], str] = {}
        self._codec = codec
        self.times_are_certain = self.memory_is_certain = True
        self.has_keys = self.panel_is_manned = self.handed_over = False
        self.acts = 0
        self._open: dict[tuple[str, str], tuple[float, int]] = {}
        self._definite: dict[tuple[str, str], int] = {}
        self._life = self._losses = 0
        self._mode, self._tip = ControlMode.AUTOMATED, TipStatus()
        self._checked: ArbitrationState | None = None
        self._saved_control: ArbitrationState | None = None
        self._saved_state: SavedState | None = None
        self.written = Written(timeline, codec, self._must, OF_THE_SENDER)
        microscope.on_executed = self.executed

    def forgets(self) -> None:
        """Note that the scheduler may be killed before it has saved its state."""
        self.times_are_certain = self.memory_is_certain = False
        self.written.is_certain = self.tip.memory_is_certain = self.limits.memory_is_certain = False

    # --- the scheduler ---

    def carried_out(self, host: SchedulerHost, effect: Effect) -> None:
        """Check an effect before it is carried out."""
        self._count_losses(host)
        self.written.carried_out(host, effect)
        if self._life != host.life:
            self._life = host.life
            self._open.clear()  # what its former life had taken in is asked again
            self._definite.clear()
            for packet, *_ in host.core.cached():  # written in a former life that died before it published
                self._published.setdefault(packet.time_ns or 0, (packet.envelope, packet.payload))
        if isinstance(effect, SaveState):
            return
        if isinstance(effect, Reply):
            self._reply(host, effect)
        elif isinstance(effect, Publish):
            self._publish(effect)
        elif isinstance(effect, Forward):
            self._forward(host, effect)
        # a scan of the translator's says nothing of control, and may go out before a change of it is saved
        if isinstance(effect, Reply) or (isinstance(effect, Publish) and effect.source_ns is None):
            self._saved(host)

    def _count_losses(self, host: SchedulerHost) -> None:
        if self._losses != host.disk.losses:
            self._losses = host.disk.losses
            self.forgets()
        # a power cut takes the last moment of the log: these packets may be published at other times
        while host.disk.forgotten:
            self._by_source.pop(host.disk.forgotten.pop(), None)

    def stepped(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        """Check the state after a step."""
        self._count_losses(host)
        self.checks += 1
        self._scheduler_since_s = host.since_s
        self._note(event, effects)
        self.written.stepped(host, event, effects)
        self.tip.stepped(host, event, effects)
        if isinstance(event, RequestIn):
            self._asked(event, effects)
            if event.name == self._holder and event.request.kind in _FORWARDED:
                self._used_ns = self._timeline.now_ns()
        elif isinstance(event, Disconnected):
            for key in [k for k, (_, connection) in self._open.items() if connection == event.connection]:
                del self._open[key]
        if isinstance(event, ReplayRequested):
            self._replayed(host, event, effects)
        self._panel(host, event, effects)
        self._control(host)
        self._presence(host)
        self._restarted(host)
        self._lease(host)
        self._answered_in_time(host)

    def _panel(self, host: SchedulerHost, event: Input | None, effects: Sequence[Effect]) -> None:
        # the microscope belongs to a person who acts at its panel, until a person lets the run continue
        control = host.core.control
        if control.mode is not ControlMode.MANUAL:
            goes_on = self._mode is ControlMode.MANUAL and isinstance(event, RequestIn)
            self._must(not (goes_on and self._tip.remedy), f"the run goes on: {self._tip.remedy}")
            self.handed_over = False
        elif self._mode is not ControlMode.MANUAL and isinstance(event, PacketIn):
            self.handed_over, self.acts = True, self.acts + 1
        self._mode = control.mode
        if not self.panel_is_manned or not isinstance(event, PacketIn):
            return
        if not any(isinstance(one, Publish) and one.packet.payload == event.packet.payload for one in effects):
            return  # it came twice
        thing = self._codec.decode_packet(event.header.message, event.packet.payload)
        if isinstance(thing, ActByHand):
            is_repeated = self._settings.control.stopped_by_hand == "repeat" and thing.act is PanelAct.STOP
            pauses = thing.act in PAUSING and not is_repeated
            outside = any(float(one.after) > 10.0 for one in thing.changes if one.parameter == names.TIP_BIAS_VOLTAGE)
            taken = control.mode is ControlMode.MANUAL or not (pauses or outside)
            self._must(taken, f"{thing}, and the run goes on")
        if isinstance(thing, TipStatus):
            self._tip = thing
            self._must(not thing.remedy or control.mode is ControlMode.MANUAL, f"{thing.by_hand}, and the run goes on")

    def _control(self, host: SchedulerHost) -> None:
        control = host.core.control
        if control is self._checked:
            return
        self._checked, state = control, host.core.control_state
        self._must(
            control.holder is None or state.mode is ControlMode.AUTOMATED, f"{control.holder} is in control in MANUAL"
        )
        if state.problems:
            self._must(
                control.holder is None or control.solving in state.problems,
                f"{control.holder} is in control, solves {control.solving}; flagged: {state.problems}",
            )
        else:
            self._must(control.solving == 0, f"{control.holder} solves {control.solving}, which is not flagged")
        if self.memory_is_certain and self._holder is not None and control.holder not in (None, self._holder):
            self.fail(f"control went from {self._holder} to {control.holder} without being given up")
        if control.holder != self._holder:
            self._held_since_s = self._timeline.monotonic_s()
            self._used_ns = self._timeline.now_ns()
        self._holder = control.holder

    def _presence(self, host: SchedulerHost) -> None:
        # a dead component does not keep control
        now_s = self._timeline.monotonic_s()
        for client in self.components:
            if client.identity != client.name:
                continue  # an impostor
            if client.alive:
                self._absent_since_s[client.name] = None
            elif self._absent_since_s.get(client.name) is None:
                self._absent_since_s[client.name] = now_s
        holder = host.core.control.holder
        if holder is None or (absent_since_s := self._absent_since_s.get(holder, 0.0)) is None:
            return
        allowed_s = max(self._settings.control.grace_s, self._settings.waits.restart_grace_s) + _SLACK_S
        since_s = max(absent_since_s, self._held_since_s, host.since_s)
        self._must(
            now_s - since_s <= allowed_s, f"{holder} has been dead for {now_s - since_s:.1f} s and is in control"
        )

    def _restarted(self, host: SchedulerHost) -> None:
        # a component that freezes in its block each time does not keep the others out for ever
        holder = host.core.control.holder
        starts = next((one.starts for one in self.components if one.name == one.identity == holder), 0)
        (*tenure, before), self._tenure = self._tenure, (holder, host.life, starts)
        if [holder, host.life] != tenure:
            self._restarts = 0
        elif self._microscope.alive and self._microscope.state is ScopeState.FREE:
            self._restarts += starts - before
        # the first report may come a restart late, and the last one a restart after it
        self._must(
            self._restarts <= MOST_RESTARTS + 2, f"{holder} was restarted {self._restarts} times, and is in control"
        )

    def _lease(self, host: SchedulerHost) -> None:
        # an idle component does not keep control
        lease_s = self._settings.control.lease_s
        if lease_s is None:
            return
        now_ns = self._timeline.now_ns()
        # while it is not free, or the scheduler may not have heard that it is, the holder is not idle
        if self._microscope.state is not ScopeState.FREE or not self._microscope.alive:
            self._idle_since_ns = None
        elif self._idle_since_ns is None:
            self._idle_since_ns = now_ns
        if self._holder is None or self._idle_since_ns is None:
            return
        at_work_ns = self._timeline.at_ns(host.since_s)
        idle_s = (now_ns - max(self._idle_since_ns, self._used_ns, at_work_ns)) / 1e9
        allowed_s = lease_s + 30.0 * self._timeline.speed
        self._must(idle_s <= allowed_s, f"{self._holder} has done nothing for {idle_s:.0f} s, its lease is {lease_s} s")

    def _saved(self, host: SchedulerHost) -> None:
        # state is saved before it is published, unless the disk is full, which is logged
        if host.disk.stale or (host.core.control is self._saved_control and host.disk.state is self._saved_state):
            return
        self._saved_control, self._saved_state = host.core.control, host.disk.state
        control, state = host.core.control, host.disk.state
        saved = ArbitrationState() if state is None else state.control
        self._must(saved == control, f"told before it was saved: {control}, saved {saved}")

    # --- requests ---

    def _asked(self, event: RequestIn, effects: Sequence[Effect]) -> None:
        key = (event.name, event.request.id)
        if event.request.kind == ControlRequest.ACTION:
            self._actions[key] = str(event.request.subject)
        if isinstance(event.request.subject, Parameter):
            self._parameters[key] = event.request.subject.name
        replied = any(isinstance(e, Reply) and e.response.id == event.request.id for e in effects)
        if event.request.id and not replied:
            self._open.setdefault(key, (self._timeline.monotonic_s(), event.connection))
            since_s, _ = self._open[key]
            self._open[key] = (since_s, event.connection)

    def _reply(self, host: SchedulerHost, reply: Reply) -> None:
        # a request has one definite answer, also when it is repeated
        response = reply.response
        key = (reply.name, response.id)
        self._open.pop(key, None)
        name = self._parameters.get(key)
        if name is not None and response.id and response.code == _SUCCESS:
            value = self._codec.decode_parameter(response.payload)
            self._must(value is not None and value.name == name, f"{key} asked for {name}, and was answered {value}")
        if response.id and response.code != _NO_RESPONSE and not any(why in response.reason for why in OF_THE_SENDER):
            before = self._definite.setdefault(key, response.code)
            self._must(before == response.code, f"{key} was answered {before}, and now {response.code}")
            action = self._actions.get(key)
            if action in _COUNTED and response.code in (_SUCCESS, _NOT_FREE):
                times = self._microscope.executed[response.id, int(ControlRequest.ACTION)]
                told = "done" if response.code == _SUCCESS else "refused"
                as_told = times == (response.code == _SUCCESS) or not self.memory_is_certain
                self._must(as_told, f"{key} was {told}, it was executed {times} times")

    def _answered_in_time(self, host: SchedulerHost) -> None:
        now_s = self._timeline.monotonic_s()
        if host.core.leave_at_s < math.inf:
            return  # the experiment has ended: whoever asks again is told so
        while self._open:
            key, (since_s, _) = next(iter(self._open.items()))
            since_s = max(since_s, host.since_s)
            allowed_s = self._settings.control.request_timeout_s + _SLACK_S
            if host.core.control.ended:  # the answers wait for the tip to be away, but not for ever
                allowed_s += self._settings.waits.answer_s
            if now_s - since_s <= allowed_s:
                return
            self.fail(f"{key} was accepted {now_s - since_s:.1f} s ago and has no answer")

    def _forward(self, host: SchedulerHost, effect: Forward) -> None:
        request = effect.request
        name = request.id.split("/")[0]
        if (self.handed_over or host.core.state.panel.why) and request.kind in _FORWARDED and not _is_get(request):
            may = name in (self._settings.rules.roles.operate or ())
            self._must(may, f"{request.subject} is sent to a microscope at which a person works")
        if request.kind in _FORWARDED and request.id and not _is_get(request):
            holder, rules = host.core.control.holder, self._settings.rules
            adjusts = isinstance(request.subject, Parameter) and request.subject.name in rules.adjustable
            may = name == holder or (adjusts and name in (rules.roles.operate or ()))
            self._must(may, f"a command of {name} is sent, {holder} holds")
            self.limits.sent(request)
            self._used_ns = self._timeline.now_ns()
            value = request.subject.value if isinstance(request.subject, Parameter) else None
            self._must(value != "nan", "a NaN is sent to the microscope")

    def executed(self, request: Request) -> None:
        """Check a command that the microscope executes."""
        self.tip.executed(request)
        self.written.executed(request)
        self.limits.executed(request)
        if request.id:
            count = self._microscope.executed[request.id, request.kind]
            once = count == 1 or request.kind != ControlRequest.ACTION or not self.memory_is_certain
            self._must(once, f"{request.id} ({request.subject}) was executed {count} times")

    # --- packets ---

    def _publish(self, effect: Publish) -> None:
        # in order, and no packet under two times, which would make it two packets
        packet, source_ns = effect.packet, effect.source_ns
        assert packet.time_ns is not None
        self._must(packet.payload != GARBLED, f"an unreadable {packet.envelope} is published")
        if source_ns is not None and self.times_are_certain:
            first_ns = self._by_source.setdefault(source_ns, packet.time_ns)
            self._must(first_ns == packet.time_ns, f"{packet.envelope} is published at {first_ns} and {packet.time_ns}")
        before = self._published.get(packet.time_ns)
        if before is not None:
            same = before == (packet.envelope, packet.payload)
            self._must(same or not self.times_are_certain, f"two packets at {packet.time_ns}")
            return  # again after a kill, at its first time
        self._published[packet.time_ns] = (packet.envelope, packet.payload)
        # a life that was killed before it published a packet has given it its time, and the translator may be slow
        was_given = source_ns is not None and packet.time_ns < self._timeline.at_ns(self._scheduler_since_s)
        self._must(
            packet.time_ns > self._last_ns or was_given or not self.memory_is_certain,
            f"{packet.envelope} is published at {packet.time_ns}, after {self._last_ns}",
        )
        self._last_ns = packet.time_ns

    def _replayed(self, host: SchedulerHost, event: ReplayRequested, effects: Sequence[Effect]) -> None:
        # exactly the cached packets that the subscriber lacks, oldest first over all envelopes
        replay = next(effect for effect in effects if isinstance(effect, Replay))
        cached = [packet for packet, *_ in host.core.cached()]
        wanted = [p for p in cached if (p.time_ns or 0) > event.since_ns and p.envelope.startswith(event.prefixes)]
        self._must(list(replay.packets) == wanted, f"a replay of {len(replay.packets)} instead of {len(wanted)}")
        times = [packet.time_ns or 0 for packet in replay.packets]
        self._must(all(a < b for a, b in itertools.pairwise(times)), "a replay out of order")

    def received(self, client: Client, packet: Packet) -> None:
        """Check a packet that is new to a component."""
        assert packet.time_ns is not None
        published = self._published.get(packet.time_ns)
        self._must(
            published == (packet.envelope, packet.payload) or not self.times_are_certain,
            f"{client.name} received {packet.envelope} at {packet.time_ns}, which nobody published",
        )

    def has_all(self, client: Client, cached: Sequence[Packet]) -> None:
        """Check that in calm weather a component has all packets that were cached a moment ago."""
        for packet in (packet for packet in cached if packet.envelope.startswith(client.listens)):
            have = client.newest.get(packet.envelope)
            self._must(
                have is not None and have[0] >= (packet.time_ns or 0),
                f"{client.name} has not got {packet.envelope} of {packet.time_ns}",
            )

    # --- answers as components get them ---

    def answered(self, client: Client, request: Request, response: Response) -> None:
        """Check that an impostor is not obeyed while the owner of the name is connected."""
        if client.identity == client.name or response.code != _SUCCESS:
            return
        self._must(not self.has_keys, f"{client.name} was obeyed as {client.identity}, whose key it has not")
        owner = next((c for c in self.components if c.name == client.identity), None)
        if owner is None or not owner.alive or owner.frozen:
            return
        # a connection that was lost by other means than the impostor's looks like a restart, until the owner speaks
        there_s = self._timeline.monotonic_s() - max(owner.since_s, owner.cut_s, self._scheduler_since_s)
        self._must(there_s < 10.0, f"{client.name} was obeyed as {client.identity}, who is there")

    # --- failing ---

    def _note(self, event: Input | None, effects: Sequence[Effect]) -> None:
        if effects or event is None:
            self._trace.append((self._timeline.monotonic_s(), event, tuple(effects)))

    def _must(self, holds: bool, what: str) -> None:
        if not holds:
            self.fail(what)

    def fail(self, what: str) -> None:
        """Raise the violation, with the last steps before it."""
        trace = "\n".join(f"{time_s:12.4f} {event} -> {list(effects)}"[:600] for time_s, event, effects in self._trace)
        raise InvariantViolated(f"at {self._timeline.monotonic_s():.4f} s: {what}\n{trace}")


def _is_get(request: Request) -> bool:
    return isinstance(request.subject, Parameter) and request.subject.value is None
