"""The part of a scheduler's state that survives a restart, as `model.snapshot` writes and reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model.idempotency_cache import SentAction
from afspm.model.instruments import GivenOrder
from afspm.model.microscope_status import TipRisk
from afspm.scheduler.control.arbitration import ArbitrationState
from afspm.scheduler.control.panel_state import PanelState
from afspm.scheduler.loans import Loan
from afspm.scheduler.overrulings import PlanBook
from afspm.scheduler.publishing.event_log import SentStart
from afspm.scheduler.safety.grants import GrantBook
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.watchdog import RetractState

KIND, VERSION = "scheduler", 2
"""Kind and version of snapshots of `SavedState`."""


@dataclass(frozen=True)
class SavedSupervisor:
    """The part of a supervisor that survives a restart of the scheduler.

    Attributes:
        processes: the names of its processes.
        orders: processes that the supervisor has to restart.
        over: for each process that has ended for good, its number of starts.
    """

    processes: tuple[str, ...]
    orders: tuple[str, ...]
    over: Mapping[str, int]


@dataclass(frozen=True)
class SavedState:
    """The state that survives a restart.

    Attributes:
        granted_to: the session token of the process that was granted control.
        lease_s: the lease that the holder requested, real.
        sessions: the token of each connected session.
        forgotten: see `idempotency_cache.Floors`.
        last_ns: the newest published time of a packet.
        recent: (translator's time, published time) of the last packets; 0 as published time: not published.
        frame: the result of `CoordinateFrame.saved`; as plain data if the state was read from a file.
        instrument_units: the first unit of each parameter of an instrument.
        instrument_orders: the number of the newest order or token.
        loans: the settings that were lent, by key.
        lent_last: see `loans.LoanBook`.
        plans: what components state, and what takes the place of it.
        given_orders: the orders that may still be carried out, or whose value is on its way.
    """

    control: ArbitrationState = field(default_factory=ArbitrationState)
    granted_to: str | None = None
    lease_s: float | None = None
    sessions: Mapping[str, str] = field(default_factory=dict)
    sent_actions: tuple[SentAction, ...] = ()
    starts: tuple[SentStart, ...] = ()
    forgotten: Mapping[str, int] = field(default_factory=dict)
    limits: LimitState = field(default_factory=LimitState)
    tip: RetractState = field(default_factory=RetractState)
    tip_risk: TipRisk = field(default_factory=TipRisk)
    supervisors: Mapping[str, SavedSupervisor] = field(default_factory=dict)
    last_ns: int = 0
    recent: tuple[tuple[int, int], ...] = ()
    frame: object = None
    instrument_units: Mapping[str, str] = field(default_factory=dict)
    instrument_orders: int = 0
    given_orders: tuple[GivenOrder, ...] = ()
    grants: GrantBook = field(default_factory=GrantBook)
    panel: PanelState = field(default_factory=PanelState)
    loans: Mapping[str, Loan] = field(default_factory=dict)
    lent_last: str = ""
    plans: PlanBook = field(default_factory=PlanBook)

    def without_holder(self) -> SavedState:
        """Return the state without a holder: an older state does not know the present holder."""
        return replace(self, control=replace(self.control, holder=None, solving=0), granted_to=None, lease_s=None)
