"""The sections of the experiment file that the scheduler enforces, as the settings of its decisions."""

from __future__ import annotations

import importlib

from afspm.errors import ConfigError
from afspm.logic.arbitration import Cause, RoleTable, Rules
from afspm.logic.envelopes import CacheRule, EnvelopeMapping, Envelopes
from afspm.logic.limits import ExperimentLimits, Limit
from afspm.logic.settings import SchedulerSettings
from afspm.logic.supervisor_registry import SUPERVISOR
from afspm.logic.watchdog import WatchdogSettings
from afspm.model import Parameter, ProblemNames, Region
from afspm.plain_data import PlainMapping

Table = PlainMapping


def scheduler_settings(
    control: Table, limits: Table, cache: Table, problems: ProblemNames, request_timeout_s: float
) -> SchedulerSettings:
    """All of them. Raises ConfigError, naming the section."""
    known = {"lease_s", "grace_s", "malfunction_after_s", "stop_scan_on_problem", "stop_scan_on_manual"}
    known |= {"retract", "dangerous", "roles", "adjustable", "end_on"}
    if unknown := control.keys() - known:
        raise ConfigError(f"unknown settings {sorted(unknown)}", where="[control]", hint=f"known: {sorted(known)}")
    try:
        return SchedulerSettings(
            rules=Rules(
                _roles(control.get("roles") or {}),
                problems,
                frozenset(control.get("adjustable") or ()),
                frozenset(map(problems.number, control.get("end_on") or ())),
            ),
            lease_s=control.get("lease_s"),
            request_timeout_s=request_timeout_s,
            watchdog=_watchdog(control),
            limits=_limits(limits),
            envelopes=_envelopes(cache),
            grace_s=control.get("grace_s", SchedulerSettings.grace_s),
            malfunction_after_s=control.get("malfunction_after_s", SchedulerSettings.malfunction_after_s),
        )
    except (TypeError, ValueError, KeyError) as error:
        raise ConfigError(f"the scheduler's settings make no sense: {error}") from error


def _roles(table: Table) -> RoleTable:
    end = table.get("end_experiment")
    return RoleTable(
        None if end is None else (*end, SUPERVISOR),  # which ends it when nothing that acts is left
        table.get("set_mode"),
        table.get("clear_problems"),
        tuple(table.get("operate") or ()),
        table.get("restart"),
    )


def _watchdog(control: Table) -> WatchdogSettings:
    default = WatchdogSettings()
    spared = set()
    if not control.get("stop_scan_on_problem", True):
        spared.add(Cause.PROBLEM)
    if not control.get("stop_scan_on_manual", True):
        spared.add(Cause.MANUAL)
    dangerous = control.get("dangerous")
    return WatchdogSettings(
        stop_when=frozenset(default.stop_when) - spared,
        dangerous=default.dangerous if dangerous is None else frozenset(dangerous),
        retract=default.retract if control.get("retract", True) else None,
    )


def _limits(table: Table) -> ExperimentLimits:
    plain = dict(table)
    for key in ("parameters", "actions"):
        plain[key] = {name: Limit(**limit) for name, limit in plain.get(key, {}).items()}
    if (region := plain.get("region")) is not None:
        center, size = tuple(region["center_m"]), tuple(region["size_m"])
        plain["region"] = Region(center, size, region.get("angle_rad", 0.0))
    plain["sets"] = {name: tuple(Parameter(*one) for one in given) for name, given in plain.get("sets", {}).items()}
    return ExperimentLimits(**plain)


def _envelopes(table: Table) -> Envelopes:
    rules = [CacheRule(**rule) for rule in table.get("rules", ())]
    name = table.get("mapping")
    return Envelopes(rules, _mapping(name) if name else None, dict(table.get("history", {})))


def _mapping(name: str) -> EnvelopeMapping:
    """The user's function "module.name"."""
    module, _, function = name.rpartition(".")
    try:
        mapping = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"the mapping {name!r} can't be loaded: {error}", where="[cache] mapping") from error
    if not callable(mapping):
        raise ConfigError(f"{name!r} is not a function", where="[cache] mapping")
    return mapping  # type: ignore[no-any-return]
