"""The state of a scheduler: a tree of frozen parts, the draft of its next state, and its snapshot."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import partial

from afspm.basics.frozen import replace
from afspm.model import ControlMode, component_of
from afspm.model.idempotency_cache import IdempotencyCache
from afspm.model.microscope_status import MicroscopeStatus
from afspm.model.sessions import SessionTable
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.control.descriptions import HandSettings
from afspm.scheduler.control.holder_timeout import HolderTimeout, Lease
from afspm.scheduler.control.lifecycle import ExperimentEnd, StartupBarrier
from afspm.scheduler.control.panel_state import PanelState
from afspm.scheduler.control.supervisor_registry import SupervisorRegistry
from afspm.scheduler.coordinate_frame import TIP_FRAME, CoordinateFrame
from afspm.scheduler.events import Codec, Effect, FrameAnswered, Log, SaveState
from afspm.scheduler.instruments.known_instruments import Instruments
from afspm.scheduler.loans import LoanBook
from afspm.scheduler.overrulings import PlanBook
from afspm.scheduler.publishing.cache import PacketCache
from afspm.scheduler.publishing.event_log import EventLog
from afspm.scheduler.requests.forwarder import Forwarder
from afspm.scheduler.requests.pending_requests import PendingRequests
from afspm.scheduler.safety.grants import GrantChecker
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.movers import MoverState
from afspm.scheduler.safety.watchdog import Watchdog
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.settings import SchedulerSettings

_WORD_S = 60.0  # from a person's word about the tip until the same person lets the run continue: one command says both


@dataclass(frozen=True)
class Peers:
    """The processes of the experiment, as far as known.

    Attributes:
        sessions: the connection of each client.
        timeout: the grace period of a holder without a connection.
        supervisors: the supervisors, whose reports name the processes that have ended.
    """

    sessions: SessionTable
    timeout: HolderTimeout
    supervisors: SupervisorRegistry = field(default_factory=SupervisorRegistry)

    def dead_at_s(self, holder: str) -> float | None:
        """Return when (real) control is revoked unless the holder comes back; None while the holder is connected."""
        over_since_s = self.supervisors.over_since_s(component_of(holder))
        return self.timeout.dead_at_s(holder, self.sessions, over_since_s)


@dataclass(frozen=True)
class SchedulerState:
    """The state that a scheduler's decisions depend on, without the packets in its cache.

    Attributes:
        logged: texts that were logged already, and are logged only once.
        frame: the map between the coordinates of components and of the microscope.
    """

    control: ArbitrationState
    lease: Lease
    peers: Peers
    idempotency: IdempotencyCache
    pending: PendingRequests
    forwarder: Forwarder
    limits: LimitChecker
    instruments: Instruments
    microscope: MicroscopeStatus
    watchdog: Watchdog
    event_log: EventLog
    barrier: StartupBarrier
    end: ExperimentEnd
    by_hand: HandSettings
    panel: PanelState
    logged: frozenset[str]
    frame: CoordinateFrame
    grants: GrantChecker
    loans: LoanBook
    plans: PlanBook

    @classmethod
    def initial(cls, settings: SchedulerSettings, frame: CoordinateFrame = TIP_FRAME) -> SchedulerState:
        dog, control, waits = settings.watchdog, settings.control, settings.waits
        return cls(
            control=ArbitrationState(ControlMode.MANUAL if control.shadow else ControlMode.AUTOMATED),
            lease=Lease(None if control.lease_s is None else round(control.lease_s * 1e9)),
            peers=Peers(SessionTable(waits.takeover_s), HolderTimeout(control.grace_s, waits.restart_grace_s)),
            idempotency=IdempotencyCache(),
            pending=PendingRequests(),
            forwarder=Forwarder(control.request_timeout_s, waits.answer_s, waits.longest_queue),
            limits=LimitChecker(
                settings.instruments.unrated(settings.limits),
                LimitState(movers=MoverState(is_unproved=bool(settings.limits.movers.movers))),
            ),
            instruments=Instruments(settings.instruments),
            microscope=MicroscopeStatus(dog.dangerous, control.malfunction_after_s),
            watchdog=Watchdog(dog),
            event_log=EventLog(),
            barrier=StartupBarrier(waits.catch_up_s),
            end=ExperimentEnd(),
            by_hand=HandSettings(),
            panel=PanelState(),
            logged=frozenset(),
            frame=frame,
            grants=GrantChecker(settings.rules, settings.limits, settings.run.name),
            loans=LoanBook(),
            plans=PlanBook(),
        )

    def saved_parts(self) -> tuple[object, ...]:
        """Return the parts whose change makes a step save the state before its other effects."""
        saved = self.control, self.lease.token, self.lease.asked_s, self.watchdog.tip, self.microscope.risk
        return (
            *saved,
            self.grants.book,
            self.panel,
            self.limits.state.usage,
            self.limits.state.movers,
            self.idempotency.sent_actions,
            self.event_log.starts,
            self.instruments.units,
            self.instruments.given,
            self.loans.loans,
            self.loans.lent_last,
            self.plans.stated,
            self.plans.rules,
        )

    def due_s(self) -> float | None:
        """Return the earliest deadline of the parts listed here, in real monotonic time; None: no deadline.

        `scheduler_core.due_s` adds the deadlines that depend on several parts.
        """
        dues = (
            self.forwarder.deadline_s(),
            self.barrier.due_s(),
            self.end.by_s,
            self.pending.due_s(line_is_free=self.forwarder.is_free),
            self.watchdog.due_s,
            self.instruments.due_s(),
            self.frame.deadline_s(),
        )
        return min((due_s for due_s in dues if due_s is not None), default=None)


@dataclass(frozen=True)
class Environment:
    """The settings, the codec and the packet cache that a step needs beside the state.

    Attributes:
        cache: the packets published last; the one part that changes in place, since it may hold hundreds of megabytes.
    """

    settings: SchedulerSettings
    codec: Codec
    cache: PacketCache


class StateParts:
    """The parts of a state, replaced one after the other during a step."""

    control: ArbitrationState
    lease: Lease
    peers: Peers
    idempotency: IdempotencyCache
    pending: PendingRequests
    forwarder: Forwarder
    limits: LimitChecker
    instruments: Instruments
    microscope: MicroscopeStatus
    watchdog: Watchdog
    event_log: EventLog
    barrier: StartupBarrier
    end: ExperimentEnd
    by_hand: HandSettings
    panel: PanelState
    logged: frozenset[str]
    frame: CoordinateFrame
    grants: GrantChecker
    loans: LoanBook
    plans: PlanBook


_PARTS = tuple(one.name for one in fields(SchedulerState))


class StateDraft(StateParts):
    """One step in progress: the parts of the state so far, the effects so far, and the time.

    Attributes:
        now_s: real monotonic time, for timeouts.
        now_ns: experiment time, for everything that has a meaning in the experiment.
        raised: inputs that this step raises for the coordinate frame, processed within the same step.
        before: the state before this step.
    """

    def __init__(self, state: SchedulerState, env: Environment, now_s: float, now_ns: int) -> None:
        self.__dict__.update(state.__dict__)
        self.env = env
        self.now_s = now_s
        self.now_ns = now_ns
        self.effects: list[Effect] = []
        self.raised: list[FrameAnswered] = []
        self.before = state
        self._is_to_be_saved = False

    def save(self) -> None:
        """Save the state after this step even if none of its `saved_parts` changed."""
        self._is_to_be_saved = True

    def others_may_have_acted(self, *, unseen: bool = False, by: str = "", is_watched: bool = False) -> None:
        """Forget where the tip and its motor are, and which settings are in force.

        Args:
            unseen, by: see `MoverState.unknown`.
            is_watched: whether a person has acted in AUTOMATED.
        """
        shown, said_s = self.panel.tip.engaged, self.limits.state.movers.cleared_s
        by = by if self.now_s - said_s < _WORD_S else ""
        self.limits = self.limits.with_movers(partial(MoverState.unknown, engaged=shown, unseen=unseen, by=by))
        if shown is not False:
            self.microscope = self.microscope.with_tip(away=False)
        self.instruments = self.instruments.changed(self.now_s)
        self.loans = self.loans.broken() if unseen else self.loans.unsure(is_watched=is_watched)

    def log(self, level: str, text: str) -> None:
        self.effects.append(Log(level, text))

    def warn(self, texts: Iterable[str]) -> None:
        for text in texts:
            self.log("WARNING", text)

    def send_forwards(self) -> None:
        if self.forwarder.outbox:
            self.effects += self.forwarder.outbox
            self.forwarder = replace(self.forwarder, outbox=())

    def finish(self) -> tuple[SchedulerState, list[Effect]]:
        """Return the new state and the effects: saving first, requests to the translator last.

        At the end of the experiment, the last packets and the KILL signal follow the requests.
        """
        self.send_forwards()
        parts = self.__dict__
        state = replace(self.before, **{name: parts[name] for name in _PARTS})
        if self._is_to_be_saved or state.saved_parts() != self.before.saved_parts():
            self.effects.insert(0, SaveState(saved_state(state, self.env)))
        return state, self.effects


def saved_state(state: SchedulerState, env: Environment) -> SavedState:
    """Return the part of a state that survives a restart."""
    return SavedState(
        control=state.control,
        granted_to=state.lease.token,
        lease_s=state.lease.asked_s,
        sessions=state.peers.sessions.tokens(),
        sent_actions=state.idempotency.sent_actions,
        starts=state.event_log.starts,
        forgotten=state.idempotency.floors.numbers,
        limits=state.limits.state,
        tip=state.watchdog.tip,
        tip_risk=state.microscope.risk,
        supervisors=state.peers.supervisors.saved(),
        last_ns=env.cache.last_ns,
        recent=tuple(env.cache.recent()),
        frame=state.frame.saved(),
        instrument_units=state.instruments.units,
        instrument_orders=state.instruments.number,
        given_orders=state.instruments.given,
        grants=state.grants.book,
        panel=state.panel,
        loans=state.loans.loans,
        lent_last=state.loans.lent_last,
        plans=state.plans.saved,
    )


def restored_state(
    saved: SavedState, settings: SchedulerSettings, frame: CoordinateFrame = TIP_FRAME
) -> SchedulerState:
    """Return the state of a scheduler after a restart.

    `SchedulerCore` restores the other parts of `saved`: the requested lease, the event log and the times of packets.

    Args:
        frame: the coordinate frame at a first start.
    """
    state = SchedulerState.initial(settings, frame.restored(saved.frame))
    sessions, supervisors = (
        state.peers.sessions.restored(saved.sessions),
        SupervisorRegistry.restored(saved.supervisors),
    )
    return replace(
        state,
        control=saved.control,
        lease=replace(state.lease, token=saved.granted_to),
        peers=replace(state.peers, sessions=sessions, supervisors=supervisors),
        idempotency=state.idempotency.restored(saved.sent_actions, saved.forgotten),
        limits=replace(state.limits, state=saved.limits),
        watchdog=state.watchdog.restored(saved.tip),
        microscope=replace(state.microscope, risk=saved.tip_risk),
        instruments=replace(
            state.instruments,
            units=saved.instrument_units,
            number=saved.instrument_orders,
            given=saved.given_orders,
        ),
        grants=replace(state.grants, book=saved.grants),
        panel=saved.panel,
        loans=LoanBook.restored(saved.loans, saved.lent_last),
        plans=saved.plans,
    )
