"""Approvals of agents: the requests that a person has approved, and the number of requests left.

An agent is a component whose commands need the approval of a person (`Rules.agents`). An approval is either of one
plan, whose requests the agent sends in order and exactly as approved, or a grant: a region, ranges and counts within
which the agent measures by itself. Both are one more set of limits for the agent, beside [limits] and [limits.roles].

    comes in      approvals, and ends of approvals; requests of agents, at arrival and right before they are sent
    state         `GrantBook`: approvals in force, and the uses of the last hour; saved before a request is sent
    always holds  a request counts at most once under its id, and only the use of a request that was certainly not
                  carried out is undone; without an approval no command of an agent is sent
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model import (
    CLOCK_REQUEST,
    LEASE_REQUEST,
    RELAY_REQUEST,
    Approval,
    Approvals,
    ControlRequest,
    ControlResponse,
    Grant,
    GrantedCount,
    PositionChange,
    ProbePosition,
    Region,
    RegionChange,
    RelayedMessage,
    Request,
    Response,
    ScanParameters,
    component_of,
    names,
)
from afspm.model.geometry import XY
from afspm.model.microscope_status import STARTS
from afspm.model.parameter_names import BASE_PARAMETERS, OF_CURVES
from afspm.model.positions import PLACES
from afspm.model.requests import LEND_REQUEST, RETURN_REQUEST
from afspm.model.snapshot import to_plain
from afspm.scheduler.control.arbitration import ArbitrationState, Rules
from afspm.scheduler.safety.limit_checker import LimitChecker, is_get
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.limits import ExperimentLimits, Limit, RoleLimits
from afspm.wire.messages import LOG, PROCESSES

AGENT_LEASE_S = 60.0
"""Lease of an agent without a lease request, in s of real time."""
LONGEST_AGENT_LEASE_S = 600.0  # real time
STALE_S = 3600.0
"""Experiment time after which a preflight is too old to be approved."""
_HOUR_NS = 3600 * 10**9
_PROBE_M = 5e-9
"""Side of the square, in m, within which a probe counts as at its set position: controllers round."""
_STOPS = frozenset({names.STOP_SCAN, names.STOP_SPEC})
"""Actions that stop a measurement: the holder of control may always send them, and they count as no use of an
approval."""
_OF_SUPERVISORS = frozenset({PROCESSES.name, LOG.name})
_PARAM = int(ControlRequest.PARAM)
_SET_REGION, _SET_PROBE = int(ControlRequest.SET_SCAN_PARAMS), int(ControlRequest.SET_PROBE_POS)
_COMMANDS = frozenset(
    map(
        int,
        (
            ControlRequest.ACTION,
            ControlRequest.PARAM,
            ControlRequest.SET_SCAN_PARAMS,
            ControlRequest.SET_ZCTRL_PARAMS,
            ControlRequest.SET_PROBE_POS,
        ),
    )
)
_ALWAYS = frozenset(
    {int(ControlRequest.ACTION_SUPPORT), int(ControlRequest.RELEASE_CTRL), CLOCK_REQUEST, RETURN_REQUEST}
)


@dataclass(frozen=True)
class SpentRequest:
    """A request that was sent under an approval or under the limits of a role.

    Attributes:
        request: the kind of the request.
        at_ns: the experiment time of sending.
        plan: the approved plan that the request is part of; empty: no plan.
        action: the action that the request starts; empty: the request is no action.
        until_ns: the experiment time at which the approval of an agent's action runs out; 0: no such action.
    """

    request_id: str
    request: int
    payload: bytes
    at_ns: int
    plan: str = ""
    action: str = ""
    until_ns: int = 0


@dataclass(frozen=True)
class HeldGrant:
    """An approval that a person has given, with its uses so far.

    Attributes:
        by: the person who approved.
        given_ns: the experiment time of the approval.
        step: the number of requests of a plan that were sent.
        unsettled: the id of the newest request of a plan, until its success is known.
        used: the uses of a grant, by action.
    """

    grant: Grant
    by: str
    given_ns: int
    step: int = 0
    unsettled: str = ""
    used: Mapping[str, int] = field(default_factory=dict)

    @property
    def until_ns(self) -> int:
        return self.given_ns + round(self.grant.lasts_s * 1e9)

    def published(self) -> Approval:
        grant = self.grant
        box = (grant.region_m, grant.ranges, grant.counts)
        return Approval(
            grant.agent, grant.plan, self.by, self.until_ns, len(grant.steps) - self.step, self.left(), *box
        )

    def left(self) -> tuple[GrantedCount, ...]:
        return tuple(
            GrantedCount(count.action, count.count - self.used.get(count.action, 0)) for count in self.grant.counts
        )


@dataclass(frozen=True)
class AgentMeasurement:
    """The newest scan or spectrum begun by an agent: it ends with the approval under which it was begun.

    Attributes:
        who: the agent; empty: the newest measurement is not of an agent, or has ended.
        until_ns: the experiment time at which that approval runs out.
        plan: the plan that was approved; empty: the approval is a grant.
        request_id: the id of the request that began it.
    """

    who: str = ""
    until_ns: int = 0
    plan: str = ""
    request_id: str = ""


@dataclass(frozen=True)
class AgentPlace:
    """The places that the agent in control has set since it got control.

    Attributes:
        until_ns: the experiment time until which the agent keeps control after a completed plan; 0: no completed plan.
    """

    who: str = ""
    region: Region | None = None
    probe_m: XY | None = None
    until_ns: int = 0

    def after(self, who: str, request: Request) -> AgentPlace:
        """Return the places after a request was carried out."""
        place = self if self.who == who else AgentPlace(who)
        match request.subject:
            case ScanParameters(region=Region() as region):
                return replace(place, region=region)
            case ScanParameters(region=RegionChange()):
                return replace(place, region=None)  # a part of a place: the whole is not known here
            case ProbePosition(xy_m=xy_m):
                return replace(place, probe_m=xy_m)
            case PositionChange():
                return replace(place, probe_m=None)
        return place

    def for_action(self, who: str, action: str) -> Region | None:
        """Return the region in which an action is expected to happen; None: the agent has not set its place."""
        if self.who != who:
            return None
        if action == names.START_SCAN:
            return self.region
        return None if self.probe_m is None else Region(self.probe_m, (_PROBE_M, _PROBE_M))


@dataclass(frozen=True)
class GrantBook:
    """The approvals and their uses, which survive a restart.

    Attributes:
        plans, grants: the approved plans and the grants, by agent.
        spent: the requests of the last hour, oldest first, by agent or component with limits of its role.
        placed: the places set by the agent in control.
        measurement: the newest measurement of an agent; it may go on after its agent has given control back.
        disturbed_ns: the last experiment time at which a problem was flagged or the mode changed.
    """

    plans: Mapping[str, HeldGrant] = field(default_factory=dict)
    grants: Mapping[str, HeldGrant] = field(default_factory=dict)
    spent: Mapping[str, tuple[SpentRequest, ...]] = field(default_factory=dict)
    placed: AgentPlace = field(default_factory=AgentPlace)
    disturbed_ns: int = 0
    measurement: AgentMeasurement = field(default_factory=AgentMeasurement)

    def approvals(self) -> Approvals:
        """Return the approvals in their published form."""
        return Approvals(
            tuple(approval.published() for held in (self.plans, self.grants) for _, approval in sorted(held.items()))
        )


def limits_digest(limits: ExperimentLimits) -> str:
    """Return a hash of all limits, as 16 hexadecimal digits."""
    plain = json.dumps(to_plain(limits, lists=True), sort_keys=True)
    return hashlib.sha256(plain.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class GrantChecker:
    """The check of agents' requests against their approvals, and of the approvals themselves."""

    rules: Rules = field(default_factory=Rules)
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    run: str = ""
    book: GrantBook = field(default_factory=GrantBook)

    # --- approvals ---

    def given(self, by: str, grant: Grant, now_ns: int, offset_m: XY | None) -> tuple[GrantChecker, str]:
        """Apply a person's approval or revocation; return also the reason of a refusal, else an empty text."""
        if not self.rules.may_approve(by):
            return self, f"{by} does not have the role approve ([control.roles])"
        if not self.rules.is_agent(grant.agent):
            agents = ", ".join(sorted(self.rules.agents)) or "none"
            return self, f"{grant.agent} is not an agent of this experiment; agents: {agents}"
        begun = self.book.measurement
        if grant.revokes:
            # its measurement ends with its approvals, also one that goes on without control
            ended = replace(begun, until_ns=min(begun.until_ns, now_ns)) if begun.who == grant.agent else begun
            return self.without(grant.agent)._with(measurement=ended), ""
        if why := self._stale(grant, now_ns, offset_m):
            return self, f"the approval is stale: {why}"
        held = HeldGrant(grant, by, now_ns)
        replaced = (self.book.plans if grant.plan else self.book.grants).get(grant.agent)
        # a completed plan is held no more: a new one replaces nothing
        if replaced is not None and (begun.who, begun.plan) == (grant.agent, replaced.grant.plan):
            begun = replace(begun, until_ns=min(begun.until_ns, held.until_ns))
        if grant.plan:
            return self._with(plans={**self.book.plans, grant.agent: held}, measurement=begun), ""
        return self._with(grants={**self.book.grants, grant.agent: held}, measurement=begun), ""

    def without(self, agent: str) -> GrantChecker:
        """Remove all approvals of an agent."""
        return self._with(plans=_less(self.book.plans, agent), grants=_less(self.book.grants, agent))

    def has_approval(self, agent: str, now_ns: int) -> bool:
        """Return whether an approval of an agent is in force."""
        return any(now_ns < approval.until_ns for approval in self._held(agent))

    def ends_ns(self, agent: str | None) -> int | None:
        """Return the experiment time at which the last approval of an agent runs out; None: it has none.

        The approval of a plan that the agent has completed since it got control counts, too.
        """
        if agent is None:
            return None
        placed = self.book.placed
        completed = [placed.until_ns] if placed.who == agent and placed.until_ns else []
        return max((*completed, *(approval.until_ns for approval in self._held(agent))), default=None)

    def control_changed(
        self, before: ArbitrationState, after: ArbitrationState, by_hand: frozenset[int], now_ns: int
    ) -> GrantChecker:
        """End the approvals that a change of control makes stale.

        A flagged problem or a changed mode ends all plans. A changed mode, `stopped-by-agent` or a problem in `by_hand`
        also ends all grants. A begun plan ends when its agent loses control.

        Args:
            by_hand: the problems that a person solves.
        """
        book = self.book
        flagged = after.problems.keys() - before.problems.keys()
        is_manual = after.mode is not before.mode
        if flagged or is_manual:
            book = replace(book, plans={}, disturbed_ns=now_ns)
        if is_manual or flagged & {*by_hand, self.rules.stop}:
            book = replace(book, grants={})
        if is_manual:  # the next measurement may be of the person at the panel
            book = replace(book, measurement=AgentMeasurement())
        if before.holder != after.holder:
            # a plan is approved for one run without interruption
            former = before.holder or ""
            begun = former in book.plans and book.plans[former].step > 0
            book = replace(book, plans=_less(book.plans, former) if begun else book.plans, placed=AgentPlace())
        return self if book is self.book else replace(self, book=book)

    def _stale(self, grant: Grant, now_ns: int, offset_m: XY | None) -> str:
        book = self.book
        if grant.run != self.run:
            return f"it is for the run {grant.run or '(none)'}, this is {self.run or '(none)'}"
        if grant.limits != limits_digest(self.limits):
            return "the limits have changed since the preflight"
        if book.disturbed_ns >= grant.since_ns:
            return "a problem was flagged, or the mode changed, since the preflight"
        if not 0 <= now_ns - grant.since_ns <= STALE_S * 1e9:
            return "the preflight is older than an hour"
        return self._drifted(grant, offset_m)

    def _drifted(self, grant: Grant, offset_m: XY | None) -> str:
        if (grant.origin_m is None) != (offset_m is None):
            return "the coordinates of components have changed since the preflight"
        if grant.origin_m is None or offset_m is None:
            return ""
        if not grant.plan:  # its region drifts with the sample
            return "" if all(map(math.isfinite, offset_m)) else "the place of the sample is not known"
        moved_m = math.dist(grant.origin_m, offset_m)
        is_near = moved_m <= grant.drift_m  # False also for NaN: the place is not known
        return "" if is_near else f"the sample has drifted by {moved_m * 1e9:.3g} nm"

    # --- requests of an agent: at arrival ---

    def refused_at_arrival(self, who: str, request: Request, now_ns: int) -> str:
        """Return the reason why an agent may not send a request; empty if the later checks decide."""
        if not self.rules.is_agent(who):
            return ""
        kind, subject = request.kind, request.subject
        if kind in _ALWAYS or is_get(request):
            return ""
        if kind == ControlRequest.ADD_EXP_PRBLM:
            return "" if subject == self.rules.stop else f"{who} is an agent: it may flag stopped-by-agent only"
        if kind == RELAY_REQUEST:
            relayed = isinstance(subject, RelayedMessage) and subject.message not in _OF_SUPERVISORS
            return "" if relayed else f"{who} is an agent: it may not publish this"
        if kind == LEASE_REQUEST:
            is_short = isinstance(subject, float) and subject <= LONGEST_AGENT_LEASE_S
            return "" if is_short else f"the lease of an agent is at most {LONGEST_AGENT_LEASE_S:g} s"
        if kind not in _COMMANDS and kind not in (ControlRequest.REQUEST_CTRL, LEND_REQUEST):
            return f"{who} is an agent: only a person may do this"
        if kind == ControlRequest.REQUEST_CTRL and subject:
            return f"{who} is an agent: it solves no problems"
        if not request.id and kind in _COMMANDS:
            return "a command of an agent needs an id"
        if not _is_stop(request) and not self.has_approval(who, now_ns):
            return f"{who} has no approval in force; a person approves a plan or gives a grant"
        return ""

    # --- requests of an agent: right before they are sent ---

    def depends_on(self, who: str, request: Request) -> list[str]:
        """Return the parameters to read before a request is checked."""
        needed: dict[str, None] = {}
        for limits in self._sets_of_limits(who):
            needed.update(dict.fromkeys(LimitChecker(limits).depends_on(request)))
        return list(needed)

    def refused(
        self, who: str, request: Request, now_ns: int, offset_m: XY | None, state: LimitState
    ) -> Response | None:
        """Return the refusal of a command that may not be sent now; None if it may.

        Args:
            offset_m: the origin of component coordinates in microscope coordinates; None: both are the same.
            state: the values in force, and the position of the tip in the microscope's coordinates.
        """
        again_ns = None
        why = self._refused_by_role(who, request, now_ns, offset_m, state)
        if not why:
            why, again_ns = self._refused_by_number(who, request, now_ns)
        why = why or self._refused_as_agent(who, request, now_ns, offset_m, state)
        return Response(int(ControlResponse.PARAM_ERROR), b"", why, request.id, again_ns=again_ns) if why else None

    def _refused_as_agent(self, who: str, request: Request, now_ns: int, offset_m: XY | None, state: LimitState) -> str:
        if not self.rules.is_agent(who):
            return ""
        # checked here as well: an approval may have ended while the request waited
        if why := self.refused_at_arrival(who, request, now_ns):
            return why
        if (known := self._spent(who, request.id)) is not None:
            is_same = (known.request, known.payload) == (request.kind, request.payload)
            return "" if is_same else "this id is of another request"
        if _is_stop(request):
            return ""
        if why := self._refused_at_place(who, request, now_ns, offset_m, state):
            return why
        plan, grant = self.book.plans.get(who), self.book.grants.get(who)
        why_not = "no plan is approved"
        if plan is not None and not (why_not := self._refused_by_plan(plan, request, now_ns, offset_m)):
            return ""
        # between two requests of a plan a grant would undo what the first has set: the bias, before the scan
        if plan is not None and plan.step and plan.until_ns > now_ns:
            return f"{why_not}; the grant waits for the end of the plan, which also ends by releasing control"
        if grant is None:
            return f"{why_not}, and there is no grant"
        refused = self._refused_by_grant(grant, who, request, now_ns, state)
        return f"{refused}; {why_not}" if refused and plan is not None else refused

    def measured(self) -> GrantChecker:
        """Register that the newest measurement has ended, or is ordered to stop."""
        is_known = self.book.measurement != AgentMeasurement()
        return self._with(measurement=AgentMeasurement()) if is_known else self

    def measuring(self, who: str, request: Request) -> GrantChecker:
        """Register that a measurement has begun while a request was in flight."""
        if self.book.measurement.who == who:
            return self  # its end may have become earlier since the request was sent
        spent = self._spent(who, request.id)
        return self.measured() if spent is None or not spent.until_ns else self._with(measurement=_begun(who, spent))

    def sending(
        self, who: str, request: Request, now_ns: int, offset_m: XY | None, *, is_measuring: bool = False
    ) -> GrantChecker:
        """Count a checked request, about to be sent, against its approval or the limits of its role.

        A repeated request is not counted again.

        Args:
            is_measuring: whether a measurement may be running, which the microscope then goes on with.
        """
        is_repeated = bool(request.id) and self._spent(who, request.id) is not None
        checker = self if is_repeated else self._counting(who, request, now_ns, offset_m)
        if not _is_start(request):
            return checker
        if not self.rules.is_agent(who):
            return checker if is_measuring else checker.measured()
        spent = checker._spent(who, request.id)
        if spent is None or not spent.until_ns:
            return checker
        begun, running = _begun(who, spent), checker.book.measurement
        if is_measuring and running.who:  # this start may be refused: an earlier end holds for both
            begun = replace(running, until_ns=min(running.until_ns, begun.until_ns))
        return checker._with(measurement=begun)

    def _counting(self, who: str, request: Request, now_ns: int, offset_m: XY | None) -> GrantChecker:
        if not self.rules.is_agent(who) and self._role(who) is None:
            return self
        action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
        book, plan = self.book, self.book.plans.get(who)
        approved, held = "", None
        if plan is not None and not self._refused_by_plan(plan, request, now_ns, offset_m):
            approved, held = plan.grant.plan, plan
            sent = replace(plan, step=plan.step + 1, unsettled=request.id)
            book = replace(book, plans={**book.plans, who: sent})
        elif action and action not in _STOPS and (held := book.grants.get(who)) is not None:
            used = {**held.used, action: held.used.get(action, 0) + 1}
            book = replace(book, grants={**book.grants, who: replace(held, used=used)})
        until_ns = held.until_ns if action and held is not None else 0
        lately = tuple(use for use in book.spent.get(who, ()) if now_ns - use.at_ns < _HOUR_NS)
        spent = SpentRequest(request.id, request.kind, request.payload, now_ns, approved, action, until_ns)
        return replace(self, book=replace(book, spent={**book.spent, who: (*lately, spent)}))

    def not_done(self, who: str, request: Request) -> GrantChecker:
        """Undo the use of a request that was certainly not carried out."""
        if not request.id or (spent := self._spent(who, request.id)) is None:
            return self
        book = self.book
        if (book.measurement.who, book.measurement.request_id) == (who, request.id):
            book = replace(book, measurement=AgentMeasurement())  # another client's measurement may be running
        plan, grant = book.plans.get(who), book.grants.get(who)
        if spent.plan:
            if plan is not None and plan.unsettled == request.id:
                book = replace(book, plans={**book.plans, who: replace(plan, step=plan.step - 1, unsettled="")})
        elif spent.action and grant is not None and grant.used.get(spent.action):
            used = {**grant.used, spent.action: grant.used[spent.action] - 1}
            book = replace(book, grants={**book.grants, who: replace(grant, used=used)})
        rest = tuple(use for use in book.spent[who] if use is not spent)
        return replace(self, book=replace(book, spent={**book.spent, who: rest}))

    def done(self, who: str, request: Request) -> GrantChecker:
        """Store the place that an agent has set, and settle a step of its plan, after a success."""
        book = self.book
        if request.kind in (_SET_REGION, _SET_PROBE) and self.rules.is_agent(who):
            book = replace(book, placed=book.placed.after(who, request))
        if _is_start(request) and not self.rules.is_agent(who):  # an agent's measurement had ended unseen
            book = replace(book, measurement=AgentMeasurement())
        plan = book.plans.get(who)
        if plan is not None and plan.unsettled and plan.unsettled == request.id:
            is_last = plan.step >= len(plan.grant.steps)
            if is_last:  # its last scan may go on, and the agent waits for it in control
                placed = book.placed if book.placed.who == who else AgentPlace(who)
                book = replace(book, placed=replace(placed, until_ns=plan.until_ns))
            settled = {} if is_last else {who: replace(plan, unsettled="")}
            book = replace(book, plans={**_less(book.plans, who), **settled})
        return self if book is self.book else replace(self, book=book)

    # --- within ---

    def _held(self, agent: str) -> list[HeldGrant]:
        return [held[agent] for held in (self.book.plans, self.book.grants) if agent in held]

    def _spent(self, who: str, request_id: str) -> SpentRequest | None:
        return next((use for use in self.book.spent.get(who, ()) if use.request_id == request_id), None)

    def _role(self, who: str) -> RoleLimits | None:
        return self.limits.roles.get(who) or self.limits.roles.get(component_of(who))

    def _sets_of_limits(self, who: str) -> list[ExperimentLimits]:
        role, placed = self._role(who), self.book.placed
        limits = [] if role is None else [role.limits]
        if who in self.book.grants:
            limits.append(ExperimentLimits(_limits_of(self.book.grants[who].grant).parameters))
        # with any region, so that the microscope is asked where it stands before an action
        places = (placed.region, None if placed.probe_m is None else Region(placed.probe_m, (_PROBE_M, _PROBE_M)))
        return limits + [
            ExperimentLimits(region=region) for region in places if region is not None and placed.who == who
        ]

    def _refused_by_role(self, who: str, request: Request, now_ns: int, offset_m: XY | None, state: LimitState) -> str:
        role = self._role(who)
        if role is None or is_get(request):
            return ""
        if why := _outside(role.limits, who, request, now_ns, offset_m, state):
            return why
        return not_of_role(role, who, request)

    def _refused_by_number(self, who: str, request: Request, now_ns: int) -> tuple[str, int | None]:
        # also returns the experiment time of the next use that the number per hour allows; None: never
        role = self._role(who)
        action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
        most = None if role is None else role.per_hour.get(action)
        is_repeated = bool(request.id) and self._spent(who, request.id) is not None
        if role is None or most is None or is_repeated:
            return "", None
        lately = [use for use in self.book.spent.get(who, ()) if use.action == action and now_ns - use.at_ns < _HOUR_NS]
        if len(lately) < most:
            return "", None
        why = f"{who} has used {action} {len(lately)} times within an hour, {most} are allowed ({role.source})"
        return why, lately[-most].at_ns + _HOUR_NS if most else None

    def _refused_by_plan(self, held: HeldGrant, request: Request, now_ns: int, offset_m: XY | None) -> str:
        grant = held.grant
        if held.until_ns <= now_ns:
            return f"the approval of {grant.plan} has run out"
        if held.unsettled:  # it may not have been carried out, and the next step relies on it
            return f"request {held.step} of {grant.plan} has no known success; send it again under its id"
        if held.step >= len(grant.steps):
            return f"all of {grant.plan} was carried out"
        if why := self._drifted(grant, offset_m):
            return f"the approval of {grant.plan} is stale: {why}"
        step = grant.steps[held.step]
        if (step.request, step.payload) != (request.kind, request.payload):
            return f"this is not request {held.step + 1} of {grant.plan}"
        return ""

    def _refused_at_place(self, who: str, request: Request, now_ns: int, offset_m: XY | None, state: LimitState) -> str:
        # a person at the panel, or another component before, may have set another place than the one approved
        action = str(request.subject) if request.kind == ControlRequest.ACTION else ""
        if not action:
            return ""
        place = self.book.placed.for_action(who, action)
        if place is None:
            return f"{who} has not set the place for {action} since it got control"
        set_by = ExperimentLimits(region=place, region_source=f"set by {who}")
        return _outside(set_by, who, request, now_ns, offset_m, state)

    def _refused_by_grant(self, held: HeldGrant, who: str, request: Request, now_ns: int, state: LimitState) -> str:
        grant, limits = held.grant, _limits_of(held.grant)
        if held.until_ns <= now_ns:
            return "the grant has run out"
        if request.kind == ControlRequest.ACTION:
            action = str(request.subject)
            left = next((granted.count for granted in held.left() if granted.action == action), None)
            if left is None:
                return f"the grant does not include the action {action}"
            if left <= 0:
                return f"the grant's number of {action} is used up"
            if grant.region is None:
                return "the grant has no region"
            placed = self.book.placed
            placing = Request(_SET_REGION, ScanParameters(placed.region))  # all corners, also if the scan is turned
            if action in names.AT_PROBE and placed.probe_m is not None:
                placing = Request(_SET_PROBE, ProbePosition(placed.probe_m))
            refusal = LimitChecker(limits).check(who, placing, now_ns)
            refusal = refusal or LimitChecker(limits, state).check_values(request)
            return "" if refusal is None else refusal.reason
        if others := _others(request, limits):
            return f"the grant does not include {others[0]}"
        if part := _part_of_place(request, limits):
            return f"{part} is a part of a place, and a grant allows whole places: set the region or the probe"
        refusal = LimitChecker(limits).check(who, request, now_ns)
        return "" if refusal is None else refusal.reason

    def _with(self, **changes: object) -> GrantChecker:
        return replace(self, book=replace(self.book, **changes))  # type: ignore[arg-type]


def not_of_role(role: RoleLimits, who: str, request: Request) -> str:
    """Return the reason why a role lacks the parameter or action of a request at any time; empty if it has it."""
    if request.kind != ControlRequest.ACTION:
        others = _others(request, role.limits) if role.parameters_only else []
        return f"{others[0]} is not among the parameters of {who} ({role.source})" if others else ""
    action = str(request.subject)
    if role.actions is None or action in role.actions or action in _STOPS:
        return ""
    return f"{action} is not among the actions of {who} ({role.source})"


def _part_of_place(request: Request, limits: ExperimentLimits) -> str:
    # a part is checked with the rest in force, which the person who gave the grant has not seen
    subject = request.subject.region if isinstance(request.subject, ScanParameters) else request.subject
    if request.kind != _PARAM and not isinstance(subject, RegionChange | PositionChange):
        return ""
    return min(PLACES.intersection(LimitChecker(limits).names_set_by(request)), default="")


def _less(held: Mapping[str, HeldGrant], agent: str) -> dict[str, HeldGrant]:
    return {name: one for name, one in held.items() if name != agent}


def _is_stop(request: Request) -> bool:
    return request.kind == ControlRequest.ACTION and request.subject in _STOPS


def _is_start(request: Request) -> bool:
    return request.kind == ControlRequest.ACTION and request.subject in STARTS


def _begun(agent: str, spent: SpentRequest) -> AgentMeasurement:
    return AgentMeasurement(agent, spent.until_ns, spent.plan, spent.request_id)


def _limits_of(grant: Grant) -> ExperimentLimits:
    # a range is in SI, and the scheduler knows the units of base parameters alone: another value with a unit is outside
    return ExperimentLimits(
        parameters={
            granted.parameter: Limit(
                granted.low,
                granted.high,
                unit=BASE_PARAMETERS.get(granted.parameter) or OF_CURVES.get(granted.parameter) or "",
                source="the grant",
            )
            for granted in grant.ranges
        },
        region=grant.region,
        region_source="the grant",
    )


def _others(request: Request, limits: ExperimentLimits) -> list[str]:
    # the parameters that a request sets beside those of the limits; a malformed one has none, and breaks the limits
    places = PLACES if limits.region is not None else frozenset()
    return [
        name for name in LimitChecker(limits).names_set_by(request) if name not in places | limits.parameters.keys()
    ]


def _outside(
    limits: ExperimentLimits,
    who: str,
    request: Request,
    now_ns: int,
    offset_m: XY | None,
    state: LimitState,
) -> str:
    checker = LimitChecker(limits)
    # in the coordinates of components: a part of a place would be completed from the microscope; the whole is what a
    # person sees
    if (refusal := checker.check(who, request, now_ns)) is None and request.kind == ControlRequest.ACTION:
        checker = replace(checker, state=state)
        # A place is known in the coordinates of the microscope, which are the same without a frame. With a frame the
        # microscope is moved to the place that the agent has set, which was checked then.
        refusal = checker.check_place(request) if offset_m is None else checker.check_values(request)
    return "" if refusal is None else refusal.reason
