"""The work of agents in a run, from proposals, approvals, the journal and measurements of its record."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

from afspm.basics import typeset_area
from afspm.basics.formatting import quantity, typeset_position
from afspm.model import (
    STOPPED_BY_AGENT,
    Approval,
    Approvals,
    ControlRequest,
    ControlResponse,
    JournalEntry,
    Proposal,
    component_of,
)
from afspm.model.parameter_names import BASE_PARAMETERS
from afspm.model.problems import STOPPER
from afspm.night.run import Run
from afspm.report.markup import PageTimes, table


@dataclass(frozen=True)
class RecordedGrant:
    """A grant in its last published form.

    Attributes:
        gone_ns: the time from which the grant was no longer published; None: in force until its expiry or the end of
            the record.
    """

    approval: Approval
    gone_ns: int | None = None


@dataclass(frozen=True)
class AgentWork:
    """The actions of one agent.

    Attributes:
        proposed, approved: number of different plans.
        refused: number of refusals by the name of the response.
        stops: times of its accepted calls of `stop`, in ns.
    """

    name: str
    proposed: int = 0
    approved: int = 0
    grants: Sequence[RecordedGrant] = ()
    scans: int = 0
    spectra: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    stops: Sequence[int] = ()


def read(run: Run) -> list[AgentWork]:
    """Return the work of each agent that proposed a plan, had an approval, was refused a request or stopped the run."""
    proposals: dict[str, set[str]] = {}
    plans: dict[str, set[tuple[str, int]]] = {}
    grants: dict[tuple[str, str, int], RecordedGrant] = {}
    for packet, _, thing in run.messages(("Proposal", "Approvals")):
        if isinstance(thing, Proposal):
            proposals.setdefault(thing.who, set()).add(thing.id)
        elif isinstance(thing, Approvals):
            for one in thing.approvals:
                if one.plan:
                    plans.setdefault(one.agent, set()).add((one.plan, one.until_ns))
            _follow(grants, thing.approvals, packet.time_ns or 0)
    stop = run.problem_names.get(STOPPED_BY_AGENT)
    stops = [entry for entry in run.journal if _stops(entry, stop)] if stop is not None else []
    stopped = {_agent(entry.who) for entry in stops if entry.who.endswith(STOPPER)}
    # a refused agent without any proposal or approval is found by the component that it shares with other agents
    components = {component_of(name) for name in (*proposals, *plans, *(agent for agent, *_ in grants), *stopped)}
    refusals = [entry for entry in run.refusals if component_of(entry.who) in components]
    names = {*proposals, *plans, *(agent for agent, *_ in grants), *stopped, *(_agent(one.who) for one in refusals)}
    return [
        AgentWork(
            name,
            len(proposals.get(name, ())),
            len({plan for plan, _ in plans.get(name, ())}),
            [one for (agent, *_), one in grants.items() if agent == name],
            sum(row.holder == name for row in run.scans),
            sum(row.holder == name for row in run.spectra),
            Counter(_response(one) for one in refusals if _agent(one.who) == name),
            [entry.time_ns for entry in stops if _agent(entry.who) == name],
        )
        for name in sorted(names)
    ]


def html(works: Iterable[AgentWork], clock: PageTimes) -> str:
    """Return a table with a row for each agent; empty without agents."""
    rows = [
        [
            escape(one.name),
            f"{one.proposed} / {one.approved}",
            "<br>".join(_grant(each, clock) for each in one.grants) or "none",
            f"{one.scans} / {one.spectra}",
            escape(", ".join(f"{count} × {code}" for code, count in sorted(one.refused.items()))) or "none",
            ", ".join(clock.both(time_ns) for time_ns in one.stops) or "none",
        ]
        for one in works
    ]
    return table(["agent", "plans proposed / approved", "grants", "scans / spectra", "refused", "stops"], rows)


def _follow(grants: dict[tuple[str, str, int], RecordedGrant], now: Collection[Approval], time_ns: int) -> None:
    current = {(one.agent, one.by, one.until_ns): one for one in now if not one.plan}
    for key, known in grants.items():
        is_over = known.gone_ns is not None or key in current or time_ns >= known.approval.until_ns
        if not is_over:
            grants[key] = RecordedGrant(known.approval, time_ns)
    grants.update({key: RecordedGrant(one) for key, one in current.items()})


def _stops(entry: JournalEntry, stop: int) -> bool:
    return entry.request == ControlRequest.ADD_EXP_PRBLM and entry.problem == stop and not entry.refused


def _agent(who: str) -> str:
    return who.removesuffix(STOPPER)


def _response(entry: JournalEntry) -> str:
    known = next((one.name for one in ControlResponse if one == entry.response), str(entry.response))
    return known.lower().replace("_", "-")


def _grant(grant: RecordedGrant, clock: PageTimes) -> str:
    one = grant.approval
    region, left = one.region, {count.action: count.count for count in one.left}
    parts = ["no place" if region is None else f"{typeset_area(region.size_m)} at {typeset_position(region.center_m)}"]
    for each in one.ranges:
        unit = BASE_PARAMETERS.get(each.parameter) or ""
        parts.append(f"{each.parameter} {quantity(each.low, unit)} to {quantity(each.high, unit)}")
    # a record of an earlier version has no counts, only the rest of them
    counts = {count.action: count.count for count in one.counts}
    parts += [f"{counts[name] - left.get(name, 0)} of {counts[name]} {name}" for name in counts]
    parts += [f"{rest} {name} left" for name, rest in left.items() if name not in counts]
    until = f"until {clock.both(one.until_ns)}"
    ended = "" if grant.gone_ns is None else f", ended at {clock.both(grant.gone_ns)}"
    return f"{escape('; '.join(parts))}; {until}{ended}; by {escape(one.by)}"
