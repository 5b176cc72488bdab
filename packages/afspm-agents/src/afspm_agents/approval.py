"""Approvals of agents' plans, and grants, as a person sends them to the scheduler."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from afspm.basics import InvalidValue, Plain, duration_text, escaped, from_json, parse_quantity, quantity, si
from afspm.model import Frame, Grant, GrantedCount, GrantedRange, Proposal, is_of_instrument, names
from afspm_agents.plan import Plan, ScanStep, plan_of

PLAN_LASTS_S = 3600.0
DRIFT_PART = 0.1
"""Largest drift of the sample between preflight and run, as a part of the shortest side of all scans."""
DRIFT_M = 10e-9
"""Largest drift between preflight and run for a plan without scans, in m."""
_FIELDS = ("agent", "for", "region", "parameters", "counts")


def simulated(proposal: Proposal) -> str:
    """Return a summary of a plan's preflight, as the agent's server published it."""
    try:
        return summary(preflight_of(proposal))
    except (InvalidValue, TypeError, ValueError, AttributeError):
        # the agent's process wrote the preflight, and any other JSON may come in its place
        return "Not simulated: the preflight can't be read."


def preflight_of(proposal: Proposal) -> Plain:
    """Return the result of a proposal's preflight; empty without a preflight.

    Raises:
        InvalidValue: the preflight is not a JSON object.
    """
    if not proposal.preflight:
        return {}
    try:
        found: object = from_json(proposal.preflight)
    except ValueError as error:
        raise InvalidValue(f"the preflight of {proposal.id} can't be read: {error}") from error
    if not isinstance(found, dict):
        raise InvalidValue(f"the preflight of {proposal.id} is no JSON object")
    return found


def summary(found: Plain) -> str:
    """Return the result of a simulated run as text."""
    harm, seconds = found.get("harm"), found.get("seconds")
    if harm is None or seconds is None:
        text = f"Not simulated: {escaped(str(found.get('error') or 'no result'))}."
    else:
        pressed_m = float(harm.get("pressed_m") or 0.0)
        tip = f", the tip changes {harm['tip_changes']} times" if harm.get("tip_changes") else ""
        pressed = quantity(pressed_m, "m", 3)
        text = f"Simulated: {duration_text(seconds)}; pressed at most {pressed} into the sample{tip}."
    refusals = [escaped(str(one)) for one in found.get("refusals") or ()]
    return f"{text} The limits will refuse: {'; '.join(refusals)}" if refusals else text


def of_plan(proposal: Proposal, frame: Frame, facts: Plain) -> tuple[Grant, Plan]:
    """Return the approval of a proposed plan, and the plan.

    Args:
        facts: the result of `Scope.approval_facts`, from before the person decides.

    Raises:
        InvalidValue: the preflight is missing, the plan is malformed, or the id is not its hash.
    """
    plan = plan_of(proposal.plan)
    if plan.id != proposal.id:
        raise InvalidValue(f"the plan of {proposal.id} has another hash: {plan.id}")
    if not proposal.preflight:
        raise InvalidValue(f"{proposal.id} has no preflight", hint="the agent calls the tool preflight first")
    sizes = [min(step.size_m) for step in plan.steps if isinstance(step, ScanStep)]
    steps = tuple(one.step for one in plan.requests(frame))
    grant = Grant(
        proposal.who, plan.id, steps, lasts_s=PLAN_LASTS_S, drift_m=min(sizes) * DRIFT_PART if sizes else DRIFT_M
    )
    return fresh(grant, facts), plan


def of_table(table: Mapping[str, object], facts: Plain) -> Grant:
    """Return the grant that a table of a TOML file describes.

    Args:
        facts: the result of `Scope.approval_facts`.

    Raises:
        InvalidValue, UnitError: a field is unknown or missing, or a quantity can't be used.
    """
    unknown, missing = [key for key in table if key not in _FIELDS], [one for one in _FIELDS[:2] if one not in table]
    if unknown or missing:
        raise InvalidValue(
            f"unknown: {', '.join(unknown)}" if unknown else f"missing: {', '.join(missing)}",
            where="grant",
            hint=f"fields: {', '.join(_FIELDS)}",
        )
    ranges = []
    for name, pair in _table(table, "parameters").items():
        if is_of_instrument(name):
            what = f"{name} is a parameter of another instrument, which a grant can't include"
            raise InvalidValue(what, where="grant, parameters", hint="approve a plan that sets it")
        unit = names.BASE_PARAMETERS.get(name) or ""
        texts = _pair(pair, name)
        # a plain "5" would be 5 V, where a person may mean mV
        if unit and not all(parse_quantity(one)[1] for one in texts):
            what = f"{' and '.join(texts)} have no unit"
            raise InvalidValue(what, where=f"grant, parameters.{name}", hint=f'as in ["-1 {unit}", "1 {unit}"]')
        low, high = (si(one, unit) for one in texts)
        ranges.append(GrantedRange(name, low, high))
    counts = []
    for action, count in _table(table, "counts").items():
        if isinstance(count, bool) or not isinstance(count, int):
            raise InvalidValue(f"{action}: {count!r} is not a whole number", where="grant, counts")
        counts.append(GrantedCount(action, count))
    region = _table(table, "region")
    region_m: tuple[float, ...] = ()
    if region:
        if set(region) != {"x", "y"}:
            raise InvalidValue("a region has x and y", where="grant, region")
        (left, right), (low, high) = (tuple(si(one, "m") for one in _pair(region[axis], axis)) for axis in "xy")
        region_m = ((left + right) / 2, (low + high) / 2, right - left, high - low)
    lasts = table["for"]
    # a plain "2" would be two seconds, which no person means
    if not isinstance(lasts, str) or not parse_quantity(lasts)[1]:
        raise InvalidValue('`for` is a time with its unit, as in "2 h"', where="grant, for")
    grant = Grant(
        str(table["agent"]), region_m=region_m, ranges=tuple(ranges), counts=tuple(counts), lasts_s=si(lasts, "s")
    )
    if grant.revokes:
        raise InvalidValue("a grant lasts longer than no time", where="grant, for")
    return fresh(replace(grant, drift_m=0.0), facts)


def fresh(grant: Grant, facts: Plain) -> Grant:
    """Return a copy of an approval, bound to the present run, limits, coordinates and time."""
    offset_m = facts.get("offset_m")
    return replace(
        grant,
        run=str(facts.get("run") or ""),
        limits=str(facts.get("limits") or ""),
        since_ns=int(facts.get("now_ns") or 0),
        offset_m=() if offset_m is None else tuple(map(float, offset_m)),
    )


def _table(table: Mapping[str, object], key: str) -> Mapping[str, object]:
    found = table.get(key, {})
    if not isinstance(found, Mapping):
        raise InvalidValue(f"{key} is not a table", where="grant")
    return found


def _pair(value: object, where: str) -> tuple[str, str]:
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 2:
        raise InvalidValue("two quantities are needed, from the lower to the higher", where=f"grant, {where}")
    if not all(isinstance(one, str) for one in value):
        raise InvalidValue("quantities are text with their units", where=f"grant, {where}")
    return (value[0], value[1])
