"""What is to be started, as launch lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from afspm.addresses import connectable, reaches
from afspm.errors import ConfigError
from afspm.experiment import limits_section, wiring
from afspm.experiment.experiment import ProcessStart
from afspm.experiment.findings import nearest
from afspm.experiment.known import DASHBOARD, DASHBOARD_PASSWORD
from afspm.experiment.parts import ExperimentPart
from afspm.experiment.toml_writer import SECRET
from afspm.launch import Launch, Sockets
from afspm.logic.microscope_status import FEEDBACK_OFF
from afspm.logic.watchdog import WatchdogSettings
from afspm.model import Frame, Role

if TYPE_CHECKING:
    from afspm.experiment.experiment import Experiment
    from afspm.experiment.resolution import ResolvedExperiment, ResolvedProcess

_ORDER = (Role.TRANSLATOR, Role.SCHEDULER, Role.COMPONENT)


def starts(
    experiment: Experiment, take_address: Callable[[], str], only: Collection[str], without: Collection[str]
) -> list[ProcessStart]:
    """The processes chosen, translator and scheduler first; clock and folders are still to be added."""
    resolved = experiment.resolved
    chosen = _with_implied(_chosen(experiment.component_names, only, without), resolved, set(only), set(without))
    links = {name: _without_gone(resolved.net.links[name], resolved, set(without)) for name in chosen}
    for part in resolved.parts.components:
        if part.implied and part.name in chosen:
            links[part.name] = _reachable(links[part.name], resolved, chosen)
    _require_addresses(resolved, links, chosen, piecemeal=bool(only))
    addresses = resolved.net.addresses(take_address)
    processes = [process for role in _ORDER for process in resolved.with_role(role) if process.name in chosen]
    return [_start(process, experiment, links[process.name], addresses, chosen) for process in processes]


def knowing_the_run(resolved: ResolvedExperiment) -> set[str]:
    """The processes that are told the identity of the run: all, unless the scheduler is of another language."""
    if all(not scheduler.part.command for scheduler in resolved.with_role(Role.SCHEDULER)):
        return set(resolved.processes)
    return {*resolved.emulators, *(translator.name for translator in resolved.with_role(Role.TRANSLATOR))}


def simulated(experiment: Experiment, only: Collection[str], without: Collection[str]) -> bool:
    """True if the microscope is simulated for certain, where these parts are started on this computer."""
    resolved = experiment.resolved
    return resolved.simulated_with(_chosen(experiment.component_names, only, without))


def _chosen(names: list[str], only: Collection[str], without: Collection[str]) -> set[str]:
    for name in [*only, *without]:
        if name not in names:
            raise ConfigError(f"there is no component {name!r}", hint=nearest(name, names))
    return {name for name in names if (not only or name in only) and name not in without}


def _with_implied(chosen: set[str], resolved: ResolvedExperiment, only: set[str], without: set[str]) -> set[str]:
    """What is not in the file is started where the scheduler is."""
    here = any(part.name in chosen for part in resolved.with_role(Role.SCHEDULER))
    implied = {part.name for part in resolved.parts.components if part.implied} - only
    return chosen | (implied - without) if here else chosen - implied


def _without_gone(
    links: wiring.ProcessSockets, resolved: ResolvedExperiment, without: set[str]
) -> wiring.ProcessSockets:
    """A component left out, of no address that anybody could know, is not there: nobody listens to it."""
    gone = {
        key
        for key, slot in resolved.net.slots.items()
        if slot.owner in without and slot.address is None and resolved.processes[slot.owner].role is Role.COMPONENT
    }
    return replace(links, subscribe=tuple(source for source in links.subscribe if source not in gone))


def _reachable(links: wiring.ProcessSockets, resolved: ResolvedExperiment, chosen: set[str]) -> wiring.ProcessSockets:
    """Nobody has to write down an address for the sake of what is not in the file."""
    slots = resolved.net.slots
    unknown = {key for key, slot in slots.items() if slot.address is None and slot.owner not in chosen}
    return replace(links, subscribe=tuple(source for source in links.subscribe if source not in unknown))


def _require_addresses(
    resolved: ResolvedExperiment, links: Mapping[str, wiring.ProcessSockets], chosen: set[str], *, piecemeal: bool
) -> None:
    """Between a process started here and one started elsewhere the address must be written down.

    Args:
        piecemeal: those that are not chosen run elsewhere; else they may just have been left out.
    """
    missing: dict[str, set[str]] = {}
    implied = {part.name for part in resolved.parts.components if part.implied}
    for name, link in resolved.net.links.items() if piecemeal else links.items():
        if name in implied:
            continue
        for key in (link.control, *links.get(name, link).subscribe):
            slot = resolved.net.slots.get(key or "")
            if slot is not None and slot.address is None and (slot.owner in chosen) != (name in chosen):
                missing.setdefault(f"[{slot.owner}] {slot.key}", set()).add(name)
    if missing:
        needed = [f"{where} (for {', '.join(sorted(users))})" for where, users in sorted(missing.items())]
        raise ConfigError(
            "where parts are started on their own, the file has to say " + "; ".join(needed),
            where=str(resolved.document.files[0]),
            hint=f'e.g. {min(missing)} = "tcp://127.0.0.1:9000", see the reference on wiring',
        )


def _start(
    process: ResolvedProcess,
    experiment: Experiment,
    links: wiring.ProcessSockets,
    addresses: Mapping[str, str],
    chosen: Collection[str],
) -> ProcessStart:
    resolved, part, role, wires = experiment.resolved, process.part, process.role, process.wires

    def bound(key: str | None) -> str | None:
        return None if key is None else addresses.get(key, key)

    def met(key: str) -> str:
        return connectable(addresses.get(key, key))

    launch = Launch(
        name=part.name,
        class_=process.class_path,
        settings={
            **resolved.processes[part.name].settings,
            **(_for_scheduler(resolved) if role is Role.SCHEDULER else {}),
        },
        sockets=Sockets(
            publish=bound(links.publish),
            subscribe=tuple(met(source) for source in links.subscribe),
            serve=bound(links.serve),
            control=met(links.control) if links.control else None,
        ),
        envelopes=process.envelopes,
        problems=resolved.named_problems,
        request_timeout_s=wires.request_timeout_s or resolved.sections.control.request_timeout,
        request_retries=_first(wires.request_retries, resolved.sections.control.request_retries),
        keys=_keys(resolved, links, addresses),
        messages=resolved.messages,
        beat_period_s=resolved.sections.restart.beat_period,
        simulated=resolved.simulated_with(chosen),
        controller=resolved.controller_of(part.name, chosen) if role is Role.TRANSLATOR else "",
        sample_coordinates=role is Role.COMPONENT and _in_sample_coordinates(resolved),
        retracts=role is Role.TRANSLATOR and _retracts(resolved),
    )
    folders = tuple(str(folder) for folder in resolved.document.folders)
    beats = part.own.get("heartbeats") is not False
    return ProcessStart(launch, role, _command(part), experiment.folder, folders, beats, _hidden(resolved, part.name))


def _hidden(resolved: ResolvedExperiment, name: str) -> tuple[str, ...]:
    """Environment variables that hold secrets, but for those of the component `name`."""
    webhook = str(resolved.sections.notify.webhook)
    every = {DASHBOARD_PASSWORD, *([webhook[1:]] if webhook.startswith("$") else [])}
    every.update(*(_secrets(resolved, part.name) for part in resolved.parts.components))
    return tuple(sorted(every - _secrets(resolved, name)))


def _secrets(resolved: ResolvedExperiment, name: str) -> set[str]:
    """Environment variables of which a component has to know the value."""
    webhook = str(resolved.processes[name].settings.get(SECRET, ""))
    operates = resolved.processes[name].says("operates")
    return {*([webhook[1:]] if webhook.startswith("$") else []), *([DASHBOARD_PASSWORD] if operates else [])}


def _command(part: ExperimentPart) -> tuple[str, ...]:
    """The command; "python" is the one that runs us, wherever that is."""
    return (sys.executable, *part.command[1:]) if part.command[:1] == ("python",) else part.command


def asking(experiment: Experiment, names: Collection[str]) -> Launch | None:
    """A launch line by which to ask the scheduler, which runs elsewhere, in the name of the first of `names`.

    None where it is not said where it is, or it is of another language and perhaps knows nothing of our requests.
    """
    resolved = experiment.resolved
    scheduler = next(iter(resolved.with_role(Role.SCHEDULER)), None)
    if scheduler is None or scheduler.part.command:
        return None
    # as those that are started here reach it; a translator, which asks nobody, by what the scheduler binds
    known = [*(resolved.net.links[name].control for name in names), f"{scheduler.name}/serve"]
    addresses = {key: slot.address for key, slot in resolved.net.slots.items()}
    address = next((found for key in known if key and (found := addresses.get(key, key)) is not None), None)
    if address is None:
        return None
    target = connectable(address)
    keys = _keys(
        resolved, wiring.ProcessSockets(), {key: found for key, found in addresses.items() if found is not None}
    )
    if keys is not None and "folder" in keys:
        keys = {**keys, target: scheduler.name}
    return Launch(next(iter(names)), sockets=Sockets(control=target), keys=keys)


def _keys(
    resolved: ResolvedExperiment, links: wiring.ProcessSockets, addresses: Mapping[str, str]
) -> dict[str, str] | None:
    """The folder of the keys, and whose key to expect at each address; see `transport.network.Network.from_launch`."""
    if resolved.keys_folder is None:
        return {"insecure": "true"} if resolved.sections.security.insecure else None
    slots = resolved.net.slots.items()
    owners = {connectable(addresses[key]): slot.owner for key, slot in slots if key in addresses}
    keys = {"folder": str(resolved.keys_folder)}
    for scheduler in resolved.with_role(Role.SCHEDULER)[:1]:
        keys["scheduler"] = scheduler.name  # whom alone a translator obeys
    for key in (links.control, *links.subscribe):
        if key is None:
            continue
        target = connectable(addresses.get(key, key))
        owner = owners.get(target) or next((o for bind, o in owners.items() if reaches(target, bind)), None)
        if owner is not None:
            keys[target] = owner
    return keys


def _in_sample_coordinates(resolved: ResolvedExperiment) -> bool:
    """Whether the scheduler maps places, as its class says."""
    schedulers = resolved.with_role(Role.SCHEDULER)
    return any(getattr(scheduler.component, "frame", None) is Frame.SAMPLE for scheduler in schedulers)


def _retracts(resolved: ResolvedExperiment) -> bool:
    """Whether a tip without feedback is to be retracted when nobody is in control any more."""
    control = resolved.sections.control
    dangerous = WatchdogSettings().dangerous if control.dangerous is None else control.dangerous
    return control.retract and FEEDBACK_OFF in dangerous


def _first(a: int | None, b: int) -> int:
    return b if a is None else a


def _operators(resolved: ResolvedExperiment) -> list[str]:
    """Components by which a person may command the microscope in MANUAL mode, as their classes say.

    And a dashboard that joins the run later, which is under no other's name.
    """
    operators = resolved.saying("operates")
    return operators if DASHBOARD in resolved.processes else [*operators, DASHBOARD]


def _for_scheduler(resolved: ResolvedExperiment) -> dict[str, Any]:
    """The sections that the scheduler enforces, as arguments of its constructor. Times in s, lengths in m.

    control: lease_s, grace_s, malfunction_after_s, stop_scan_on_problem, stop_scan_on_manual, retract, dangerous,
        spectra_by_variable, roles (name of the role -> names; None: everyone).
    limits: see `limits.to_settings`; cache: see `caching.Caching.to_settings`.
    """
    control = resolved.sections.control
    return {
        "control": {
            "lease_s": control.lease,
            "grace_s": control.grace,
            "malfunction_after_s": control.malfunction_after,
            "stop_scan_on_problem": control.stop_scan_on_problem,
            "stop_scan_on_manual": control.stop_scan_on_manual,
            "retract": control.retract,
            "spectra_by_variable": control.spectra_by_variable,
            "dangerous": None if control.dangerous is None else list(control.dangerous),
            "roles": {
                **{role: None if who is None else list(who) for role, who in control.roles},
                "operate": _operators(resolved) if control.roles.operate is None else list(control.roles.operate),
            },
        },
        "limits": limits_section.to_settings(resolved.limits),
        "cache": resolved.caching.to_settings(),
    }
