"""Processes to start, with their launch lines."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from afspm.basics.addresses import connectable, reaches
from afspm.basics.errors import ConfigError
from afspm.basics.launch import Launch, Sockets
from afspm.basics.requirements import require
from afspm.experiment.findings import Finding, Level, nearest
from afspm.experiment.implied_parts import RECORDS, runnable
from afspm.experiment.toml_lines import Settings
from afspm.experiment.toml_writer import SECRETS
from afspm.experiment.wiring_classes import ProcessSockets
from afspm.model import Frame, Role
from afspm.model.microscope_status import FEEDBACK_OFF
from afspm.model.snapshot import to_plain

if TYPE_CHECKING:
    from afspm.experiment.resolved_experiment import ResolvedExperiment, ResolvedProcess

DASHBOARD = "dashboard"
"""Name under which `afspm dashboard` joins a run."""
TERMINAL = "terminal"
"""Name under which commands such as `afspm approve` join a run."""
DASHBOARD_PASSWORD = "AFSPM_DASHBOARD_PASSWORD"
"""Environment variable that only dashboards get."""
# each connects to a socket that the process before it binds
_ORDER = (Role.TRANSLATOR, Role.SCHEDULER, Role.COMPONENT)


@dataclass(frozen=True)
class ProcessStart:
    """One process to start.

    Attributes:
        launch: line for its standard input; the supervisor adds heartbeat, log, clock and folders, unless
            `Experiment.launches` has filled them in.
        command: program and arguments; empty: the Python host runs `launch.class_`.
        folder: working directory of commands: the experiment file's folder.
        beats: whether it sends heartbeats; without (`heartbeats = false`) only an exit shows that a process is dead.
        python_path: folders to put before PYTHONPATH, so that modules beside the file are found.
        leaves_last: whether it stays until the other components have ended, to record their last packets.
        acts: whether it follows a plan of its own, as a series does (True if unknown), or only reacts.
        hidden: environment variables that hold secrets of other processes.
        solves: the problems that it declares to solve.
    """

    launch: Launch
    role: Role
    command: tuple[str, ...]
    folder: Path
    python_path: tuple[str, ...]
    beats: bool = True
    leaves_last: bool = False
    acts: bool = False
    hidden: tuple[str, ...] = ()
    solves: tuple[str, ...] = ()


def starts(
    resolved: ResolvedExperiment, take_address: Callable[[], str], only: Collection[str], without: Collection[str]
) -> list[ProcessStart]:
    """Return the processes to start here, translator and scheduler first; clock and folders are added later."""
    implied = {name for name, process in resolved.processes.items() if process.part.implied}
    chosen = chosen_names(resolved, only, without)
    if any(scheduler.name in chosen for scheduler in resolved.with_role(Role.SCHEDULER)):
        chosen |= implied - set(only) - set(without)  # implied parts start where the scheduler does
    else:
        chosen -= implied - set(only)
    links = {name: _subscribing(resolved, name, chosen, set(without)) for name in chosen}
    # with `only` the others run elsewhere; without, they may just have been left out
    _require_addresses(resolved, {**resolved.net.links, **links} if only else links, chosen, implied)
    addresses = resolved.net.addresses(take_address)
    processes = [process for role in _ORDER for process in resolved.with_role(role) if process.name in chosen]
    made = [_start(process, resolved, links[process.name], addresses, chosen) for process in processes]
    solved = _solved(resolved, without)
    return [
        replace(one, launch=replace(one.launch, solved=solved)) if one.role is Role.SCHEDULER else one for one in made
    ]


def knowing_the_run(resolved: ResolvedExperiment) -> set[str]:
    """Return the processes that get the run's identity.

    These are all processes; with a scheduler in another language only the translator and emulators.
    """
    if all(not scheduler.part.command for scheduler in resolved.with_role(Role.SCHEDULER)):
        return set(resolved.processes)
    return {*resolved.emulators, *(translator.name for translator in resolved.with_role(Role.TRANSLATOR))}


def chosen_names(resolved: ResolvedExperiment, only: Collection[str], without: Collection[str]) -> set[str]:
    """Return the names of the processes to start here.

    Raises:
        ConfigError: there is no such component.
    """
    names = list(resolved.processes)
    for name in [*only, *without]:
        if name not in names:
            raise ConfigError(f"there is no component {name!r}", hint=nearest(name, names))
    return {name for name in names if (not only or name in only) and name not in without}


def ends_idle(resolved: ResolvedExperiment, names: Collection[str]) -> bool:
    """Return whether a run of these processes ends once no process with a plan is left.

    True only with [control] idle = "end", and if all processes with plans, and the scheduler, are started here: plans
    elsewhere may go on.
    """
    acting = {name for name, process in resolved.processes.items() if process.role is Role.COMPONENT and process.acts}
    schedulers = {scheduler.name for scheduler in resolved.with_role(Role.SCHEDULER)}
    return resolved.sections.control.idle == "end" and (acting | schedulers) <= set(names)


def not_installed(resolved: ResolvedExperiment, names: Collection[str]) -> Iterator[Finding]:
    """Yield an error for each of these processes whose class needs a package that is not installed here."""
    for process in resolved.processes.values():
        try:
            if process.name in names:
                require(process.component)
        except ConfigError as error:
            place = resolved.document.place(process.name, "class")
            yield Finding(Level.ERROR, f"[{process.name}] class: {error.what}", place, error.hint)


def _subscribing(resolved: ResolvedExperiment, name: str, chosen: set[str], without: set[str]) -> ProcessSockets:
    # Left out: publishers without an address that are not started here. Parts that the file does not mention must not
    # force an address into it.
    links, is_implied = resolved.net.links[name], resolved.processes[name].part.implied
    unknown = {
        key
        for key, slot in resolved.net.slots.items()
        if slot.address is None
        and (
            (slot.owner in without and resolved.processes[slot.owner].role is Role.COMPONENT)
            or (is_implied and slot.owner not in chosen)
        )
    }
    return replace(links, subscribe=tuple(source for source in links.subscribe if source not in unknown))


def _require_addresses(
    resolved: ResolvedExperiment, links: Mapping[str, ProcessSockets], chosen: set[str], implied: set[str]
) -> None:
    missing: dict[str, set[str]] = {}
    for name in links.keys() - implied:
        for key in (links[name].control, *links[name].subscribe):
            slot = resolved.net.slots.get(key or "")
            if slot is not None and slot.address is None and (slot.owner in chosen) != (name in chosen):
                missing.setdefault(f"[{slot.owner}] {slot.key}", set()).add(name)
    if missing:
        needed = [f"{where} (for {', '.join(sorted(users))})" for where, users in sorted(missing.items())]
        raise ConfigError(
            "to start parts separately, the file must hold " + "; ".join(needed),
            where=str(resolved.document.files[0]),
            hint=f'e.g. {min(missing)} = "tcp://127.0.0.1:9000", see the reference on wiring',
        )


def _start(
    process: ResolvedProcess,
    resolved: ResolvedExperiment,
    links: ProcessSockets,
    addresses: Mapping[str, str],
    chosen: Collection[str],
) -> ProcessStart:
    name, command, role, wires = process.name, process.part.command, process.role, process.wires
    control = resolved.sections.control

    def bound(key: str | None) -> str | None:
        return None if key is None else addresses.get(key, key)

    def met(key: str) -> str:
        return connectable(addresses.get(key, key))

    launch = Launch(
        name=name,
        class_=process.class_path,
        settings={**process.settings, **(_for_scheduler(resolved) if role is Role.SCHEDULER else {})},
        sockets=Sockets(
            publish=bound(links.publish),
            subscribe=tuple(met(source) for source in links.subscribe),
            serve=bound(links.serve),
            control=met(links.control) if links.control else None,
        ),
        envelopes=process.envelopes,
        problems=resolved.named_problems,
        request_timeout_s=wires.request_timeout_s or control.request_timeout_s,
        request_retries=control.request_retries if wires.request_retries is None else wires.request_retries,
        keys=_keys(resolved, links, addresses),
        messages=resolved.messages,
        beat_period_s=resolved.sections.restart.beat_period,
        simulated=resolved.simulated_with(chosen),
        controller=resolved.controller_of(name, chosen) if role is Role.TRANSLATOR else "",
        sample_coordinates=role is Role.COMPONENT and _in_sample_coordinates(resolved),
        retracts=role is Role.TRANSLATOR and _retracts_when_released(resolved),
        adjustable=control.adjustable if role is Role.TRANSLATOR else (),
        after=process.after,
        keeps_requests=resolved.sections.record.requests and role is not Role.TRANSLATOR,
    )
    folders = resolved.document.folders
    command = runnable(command, folders[0])
    beats, solves = process.part.own.get("heartbeats") is not False, process.declared.solves
    hidden, is_last = _hidden_variables(resolved, process), process.declares(RECORDS)
    acts = role is Role.COMPONENT and process.acts
    return ProcessStart(
        launch, role, command, folders[0], tuple(map(str, folders)), beats, is_last, acts, hidden, solves
    )


def _hidden_variables(resolved: ResolvedExperiment, process: ResolvedProcess) -> tuple[str, ...]:
    # environment variables with secrets of other processes
    notify = resolved.sections.notify
    every = {DASHBOARD_PASSWORD, *_variable_name(notify.webhook), *_variable_name(notify.ping)}
    every.update(*map(_secrets, resolved.processes.values()))
    return tuple(sorted(every - _secrets(process)))


def _secrets(process: ResolvedProcess) -> set[str]:
    return {
        *(name for key in SECRETS for name in _variable_name(process.settings.get(key))),
        *([DASHBOARD_PASSWORD] if process.declares("operates") else []),
    }


def _variable_name(secret: object) -> list[str]:
    return [secret[1:]] if isinstance(secret, str) and secret.startswith("$") else []


def asking(resolved: ResolvedExperiment, names: Collection[str]) -> Launch | None:
    """Return a launch line for requests to a scheduler elsewhere; the sender is the first of `names`.

    None if the file lacks the scheduler's address, or the scheduler is a command, which may not know these requests.
    """
    scheduler = next(iter(resolved.with_role(Role.SCHEDULER)), None)
    if scheduler is None or scheduler.part.command:
        return None
    # the address that processes here connect to; else (a translator sends no requests) the one the scheduler binds
    known = [*(resolved.net.links[name].control for name in names), f"{scheduler.name}/serve"]
    slots = resolved.net.slots.items()
    addresses = {key: slot.address for key, slot in slots if slot.address is not None}
    opened = {key for key, slot in slots if slot.address is None}
    address = next((addresses.get(key, key) for key in known if key and key not in opened), None)
    if address is None:
        return None
    target, keys = connectable(address), _keys(resolved, ProcessSockets(), addresses)
    if keys is not None and "folder" in keys:
        keys = {**keys, target: scheduler.name}
    return Launch(next(iter(names)), sockets=Sockets(control=target), keys=keys)


def _keys(resolved: ResolvedExperiment, links: ProcessSockets, addresses: Mapping[str, str]) -> dict[str, str] | None:
    if resolved.keys_folder is None:
        return {"insecure": "true"} if resolved.sections.security.insecure else None
    slots = resolved.net.slots.items()
    owners = {connectable(addresses[key]): slot.owner for key, slot in slots if key in addresses}
    keys = {"folder": str(resolved.keys_folder)}
    for scheduler in resolved.with_role(Role.SCHEDULER)[:1]:
        keys["scheduler"] = scheduler.name  # a translator obeys this scheduler alone
    for key in (links.control, *links.subscribe):
        if key is None:
            continue
        target = connectable(addresses.get(key, key))
        owner = owners.get(target) or next((o for bind, o in owners.items() if reaches(target, bind)), None)
        if owner is not None:
            keys[target] = owner
    return keys


def _in_sample_coordinates(resolved: ResolvedExperiment) -> bool:
    return any(scheduler.frame is Frame.SAMPLE for scheduler in resolved.with_role(Role.SCHEDULER))


def _solved(resolved: ResolvedExperiment, without: Collection[str]) -> tuple[str, ...]:
    solvers = (process for process in resolved.processes.values() if process.name not in without)
    return tuple(sorted({problem for process in solvers for problem in process.declared.solves}))


def _retracts_when_released(resolved: ResolvedExperiment) -> bool:
    # a tip without feedback drifts into the sample: it is retracted once no component is in control
    watchdog = resolved.sections.control.watchdog()
    return watchdog.retract is not None and FEEDBACK_OFF in watchdog.dangerous


def _for_scheduler(resolved: ResolvedExperiment) -> Settings:
    control = resolved.sections.control
    if control.roles.operate is None:
        # components through which a person sends requests, and a dashboard that joins later, under its usual name
        operators = resolved.declaring("operates")
        operate = operators if DASHBOARD in resolved.processes else [*operators, DASHBOARD]
        control = replace(control, roles=replace(control.roles, operate=tuple(operate)))
    if control.agents is None:
        control = replace(control, agents=tuple(resolved.declaring("needs_approval")))
    if control.roles.approve is None:
        approve = (*(control.roles.operate or ()), TERMINAL)
        control = replace(control, roles=replace(control.roles, approve=approve))
    sections = {
        "control": to_plain(control),
        "limits": to_plain(resolved.limits),
        "cache": to_plain(resolved.caching),
    }
    # a scheduler of another package need not know instruments
    return {**sections, "conditions": to_plain(resolved.conditions)} if resolved.conditions.instruments else sections
