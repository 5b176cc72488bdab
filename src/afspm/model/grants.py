"""Approvals of persons for agents: of one plan, or grants, which are bounds for measurements without a plan."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from afspm.basics.errors import InvalidValue
from afspm.model.geometry import XY, Region
from afspm.model.parameter_names import BIAS_OF_SAMPLE, TIP_BIAS_VOLTAGE

MOST_STEPS = 1000  # requests in a plan
MOST_COUNT = 10_000  # times that one action is granted
LONGEST_GRANT_S = 7 * 86_400.0  # a week
LONGEST_PROPOSAL = 60_000
"""Largest length of a plan or a preflight, in characters."""


@dataclass(frozen=True, slots=True)
class GrantedStep:
    """One request of an approved plan, exactly as sent later.

    Attributes:
        request: the number of a ControlRequest.
    """

    request: int
    payload: bytes = b""


@dataclass(frozen=True, slots=True)
class GrantedRange:
    """A parameter that may be set, and its lowest and highest value, in SI."""

    parameter: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class GrantedCount:
    """An action, and the largest number of its uses."""

    action: str
    count: int


@dataclass(frozen=True, slots=True)
class Grant:
    """A person's approval for one agent: of one plan, or a grant.

    Attributes:
        agent: "component:name".
        plan: the id of the approved plan; empty: a grant.
        steps: all requests of the plan, in order.
        region_m: the region of a grant: x and y of the centre, width, height; empty: no place may be set.
        ranges, counts: the parameters and actions that a grant allows; all others are refused.
        lasts_s: duration of the approval in experiment time; 0: all approvals of the agent end.
        run: the run for which the approval is valid.
        limits: digest of the limits that the plan was checked against.
        since_ns: the time of that check. The scheduler refuses an approval as stale if a problem was flagged or the
            mode changed since then, or after an hour.
        offset_m: the origin of component coordinates in microscope coordinates at that check; empty: the scheduler maps
            no coordinates.
        drift_m: largest change of the offset; beyond it the approval of a plan is refused, too.

    Raises:
        InvalidValue: a number out of range.
    """

    agent: str
    plan: str = ""
    steps: tuple[GrantedStep, ...] = ()
    region_m: tuple[float, ...] = ()
    ranges: tuple[GrantedRange, ...] = ()
    counts: tuple[GrantedCount, ...] = ()
    lasts_s: float = 0.0
    run: str = ""
    limits: str = ""
    since_ns: int = 0
    offset_m: tuple[float, ...] = ()
    drift_m: float = 0.0

    def __post_init__(self) -> None:
        numbers = (*self.region_m, *self.offset_m, self.lasts_s, self.drift_m)
        if not all(map(math.isfinite, numbers)) or not 0.0 <= self.lasts_s <= LONGEST_GRANT_S or self.drift_m < 0.0:
            raise InvalidValue(f"a grant with the numbers {numbers}", hint=f"finite; at most {LONGEST_GRANT_S:g} s")
        if len(self.region_m) not in (0, 4) or len(self.offset_m) not in (0, 2) or min(self.region_m[2:] or (1,)) <= 0:
            raise InvalidValue(f"a grant for the region {self.region_m}", hint="x, y, width and height in m")
        if len(self.steps) > MOST_STEPS:
            raise InvalidValue(f"a plan of {len(self.steps)} requests", hint=f"at most {MOST_STEPS}")
        if bool(self.plan) != bool(self.steps):
            raise InvalidValue("an approved plan has an id and steps, a grant has neither")
        for one in self.ranges:
            if one.parameter == BIAS_OF_SAMPLE:
                raise InvalidValue(f"a grant for {one.parameter}", hint=f"name {TIP_BIAS_VOLTAGE}, which is the same")
            if not (math.isfinite(one.low) and math.isfinite(one.high) and one.low <= one.high):
                raise InvalidValue(f"a grant for {one.parameter} from {one.low} to {one.high}")
        for each in self.counts:
            if not 0 <= each.count <= MOST_COUNT:
                raise InvalidValue(f"a grant for {each.count} times {each.action}", hint=f"at most {MOST_COUNT}")

    @property
    def region(self) -> Region | None:
        return _region(self.region_m)

    @property
    def origin_m(self) -> XY | None:
        return (self.offset_m[0], self.offset_m[1]) if self.offset_m else None

    @property
    def revokes(self) -> bool:
        return self.lasts_s == 0.0


@dataclass(frozen=True, slots=True)
class Approval:
    """An approval in force.

    Attributes:
        plan: the id of the approved plan; empty: a grant.
        by: the person who approved.
        left: the actions that a grant still allows, with the remaining counts.
        region_m, ranges, counts: the bounds of a grant, as in `Grant`.
    """

    agent: str
    plan: str
    by: str
    until_ns: int
    steps_left: int = 0
    left: tuple[GrantedCount, ...] = ()
    region_m: tuple[float, ...] = ()
    ranges: tuple[GrantedRange, ...] = ()
    counts: tuple[GrantedCount, ...] = ()

    @property
    def region(self) -> Region | None:
        return _region(self.region_m)


@dataclass(frozen=True, slots=True)
class Approvals:
    """All approvals in force."""

    approvals: tuple[Approval, ...] = ()


@dataclass(frozen=True, slots=True)
class Proposal:
    """A plan that an agent proposes; after the proposal the plan no longer changes.

    Attributes:
        who: "component:name".
        id: the hash of the plan.
        plan: JSON in its canonical form.
        preflight: result of the preflight as JSON; empty without a preflight.
    """

    time_ns: int
    who: str
    id: str
    plan: str
    preflight: str = ""


def with_proposal(known: Mapping[str, Proposal], proposal: Proposal, most: int) -> dict[str, Proposal]:
    """Return at most `most` proposals by id with one more, newest last.

    An id is the hash of the plan, which all can read: a plan that another agent proposes again stays the first one's,
    with its preflight.
    """
    first = known.get(proposal.id)
    if first is not None and first.who != proposal.who:
        return dict(known)
    rest = {id_: one for id_, one in known.items() if id_ != proposal.id}
    return dict([*rest.items(), (proposal.id, proposal)][-most:])


def _region(numbers_m: tuple[float, ...]) -> Region | None:
    if not numbers_m:
        return None
    x, y, width, height = numbers_m
    return Region((x, y), (width, height))
