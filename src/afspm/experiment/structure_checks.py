"""Checks between the parts of an experiment: its processes, their connections, the problems they solve."""

from __future__ import annotations

import contextlib
import inspect
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import filterfalse
from pathlib import Path
from typing import Final

from afspm import wire
from afspm.basics.addresses import EXAMPLE, hint_on, is_address, reaches
from afspm.basics.errors import InvalidValue
from afspm.basics.formatting import counted, quantity
from afspm.client.component import Component
from afspm.experiment import class_loader, component_settings
from afspm.experiment.findings import Finding, Level, closest, nearest
from afspm.experiment.implied_parts import NO_PROGRAM, RECORDS, check_notify, is_program
from afspm.experiment.resolved_experiment import ResolvedExperiment, ResolvedProcess
from afspm.experiment.toml_lines import Settings
from afspm.experiment.wiring_classes import WIRE_SETTINGS, BoundSocket, wire_of
from afspm.model import Role, component_of, is_of_instrument, names
from afspm.model.events import LONGEST_PROCESS_NAME, PERSON, is_process_name
from afspm.transport import is_local
from afspm.wire.messages import CONDITIONS, SCAN_LINES

OPENS_PLAIN: Final = "opens_plain"
"""Class attribute that marks a component through which programs without keys can send requests."""
MICROSCOPE_ELSEWHERE: Final = "microscope_elsewhere"
"""Class attribute of a scheduler that commands no translator of the file: advice for a file that has one."""
LENDS_MICROSCOPE: Final = "lends_microscope"
"""Static method of a component: returns whether, with given settings, it acts as a microscope for other schedulers."""
FILE_SUFFIX: Final = "file_suffix"
"""Class attribute of a component that writes a file into the run folder: `file` of its settings, and this suffix."""
FASTEST_WITHOUT_WAIT: Final = 60.0
"""Speed at which scans of minutes still have lines in half a second of real time."""
_OF_EACH_RUN = ("experiment.toml", "journal.sqlite", "log.txt", "report.html", "run.json")
ADDRESS: Final = "address"
"""Usual name of a translator's setting for the address of its controller."""
_WORD = re.compile(r"[A-Za-z_][\w-]*")
_USUAL_PULSE_V = 10.0
"""Outputs of the usual controllers reach 10 V; a larger voltage is likely to be in another unit."""
# high, so that an unrelated method named on_… is no typo of a handler
_HANDLER_CUTOFF = 0.8
_CALLED_METHODS = ("run", *(name for name in vars(Component) if name.startswith("on_")))
_MISSING = {
    Role.SCHEDULER: 'add [scheduler] with component = true and class = "Scheduler"',
    Role.TRANSLATOR: 'add e.g. [microscope] with component = true and class = "Simulator"',
}


def check(resolved: ResolvedExperiment) -> None:
    """Run every check; errors and warnings go to the document's findings.

    If scheduler or translator is missing, or a class can't be loaded, checks that depend on them are left out.
    """
    for check_part in CHECKS if _is_complete(resolved) else ALWAYS:
        check_part(resolved)


def _is_complete(resolved: ResolvedExperiment) -> bool:
    return _all_loaded(resolved) and all(resolved.with_role(role) for role in _required(resolved))


def _required(resolved: ResolvedExperiment) -> dict[Role, str]:
    return {Role.SCHEDULER: _MISSING[Role.SCHEDULER]} if _microscope_elsewhere(resolved) else _MISSING


def _microscope_elsewhere(resolved: ResolvedExperiment) -> dict[str, str]:
    # advice by scheduler
    schedulers = resolved.with_role(Role.SCHEDULER)
    advice = {scheduler.name: getattr(scheduler.component, MICROSCOPE_ELSEWHERE, "") for scheduler in schedulers}
    return {name: text for name, text in advice.items() if text}


def _all_loaded(resolved: ResolvedExperiment) -> bool:
    processes = resolved.processes.values()
    is_loaded = all(process.part.command or process.component for process in processes)
    return is_loaded and len(processes) == len(resolved.parts.components)


def check_roles(resolved: ResolvedExperiment) -> None:
    """Require one scheduler, one translator (if the scheduler needs one), and names that differ by more than case."""
    for role, hint in _required(resolved).items():
        having = resolved.with_role(role)
        if not having and (name := _not_a_component(resolved, role)):
            resolved.document.error(f"there is no {role.value}", name, hint=f"[{name}] needs `component = true`")
        elif not having and _all_loaded(resolved):  # a class that can't be loaded may be the missing one
            is_instrument = len(resolved.processes) == len(resolved.with_role(Role.TRANSLATOR)) > 0
            laid_over = "; a file of an instrument is checked over an experiment: afspm check EXPERIMENT.toml THIS.toml"
            resolved.document.error(f"there is no {role.value}", hint=hint + laid_over * is_instrument)
        for extra in having[1:]:
            what = f"[{extra.name}] is a second {role.value} beside [{having[0].name}]"
            resolved.document.error(what, extra.name, hint="one is enough")
    seen: dict[str, str] = {}
    for name in resolved.processes:
        other = seen.setdefault(name.casefold(), name)
        if other != name:
            what = f"[{name}] and [{other}] differ only in upper and lower case"
            resolved.document.error(what, name, hint="their files would be the same on some computers")


def _not_a_component(resolved: ResolvedExperiment, role: Role) -> str | None:
    for name, table in resolved.parts.intermediaries.items():
        with contextlib.suppress(class_loader.Unloadable):
            if (
                "component" not in table
                and class_loader.role_of(class_loader.load(class_loader.full_path(str(table.get("class", ".")))))
                is role
            ):
                return name
    return None


def check_names(resolved: ResolvedExperiment) -> None:
    """Require names that are valid for files, on every system, and for connections."""
    for name in resolved.processes:
        if not is_process_name(name):
            hint = f"letters, digits, _, - and spaces, at most {LONGEST_PROCESS_NAME} bytes, as in [tip_corrector]"
            resolved.document.error(f"[{name}] can't be the name of a component", name, hint=hint)


def check_commands(resolved: ResolvedExperiment) -> None:
    """Require that the program of each command exists."""
    for part in resolved.parts.components:
        if part.command and not is_program(part.command[0], resolved.document.folders[0]):
            what = f"[{part.name}] there is no program {part.command[0]!r}"
            resolved.document.error(what, part.name, "command", hint=NO_PROGRAM)


def check_intermediaries(resolved: ResolvedExperiment) -> None:
    """Require known settings, numbers and valid addresses in intermediary tables."""
    known = [*resolved.parts.variables, *resolved.parts.intermediaries]
    for name, table in resolved.parts.intermediaries.items():
        kind = wire_of(table)
        if kind is None:
            continue
        for key, value in table.items():
            if key != "class" and key not in WIRE_SETTINGS[kind]:
                what = f"[{name}] a {kind.value} has no setting {key!r}"
                resolved.document.error(what, name, key, hint=nearest(key, WIRE_SETTINGS[kind]))
            elif key in ("request_timeout_ms", "request_retries") and not isinstance(value, int | float):
                hint = "is it in a second file, to be laid over this one?"
                resolved.document.error(f"[{name}] {key} = {value!r} is not a number", name, key, hint=hint)
            elif key.endswith("url"):
                for url in value if isinstance(value, list) else [value]:
                    if not isinstance(url, str) or not is_address(url):
                        near = closest(str(url), known, 0.7)
                        hint = f"did you mean {near!r}?" if near else hint_on(str(url)) or EXAMPLE
                        resolved.document.error(f"[{name}] {key} = {url!r} is not an address", name, key, hint=hint)


def check_addresses(resolved: ResolvedExperiment) -> None:
    """Refuse addresses that are bound twice, open to the network without keys, or connected to but not bound."""
    bound: dict[str, BoundSocket] = {}
    security = resolved.sections.security
    secure = security.keys is not None or security.insecure
    for slot in (*resolved.net.slots.values(), *resolved.listening):
        if slot.address is None:
            continue
        for address, other in bound.items():
            if reaches(slot.address, address) or reaches(address, slot.address):
                what = f"[{slot.owner}] and [{other.owner}] both bind {slot.address} ({slot.use}, {other.use})"
                resolved.document.findings.error(what, slot.place)
        bound[slot.address] = slot
        if slot.keyed and is_address(slot.address) and not is_local(slot.address) and not secure:
            resolved.document.findings.error(
                f"[{slot.owner}] binds {slot.address}, which other computers can reach, without keys",
                slot.place,
                'make keys with `afspm keys` and set [security] keys = "keys"; or say [security] insecure = true',
            )
    if not all(is_address(address) for address in bound):
        return  # a text that is no address was reported above; connections to it may be right
    for name, links in resolved.net.links.items():
        for target in (links.control, *links.subscribe):
            if target is None or target in resolved.net.slots or not is_address(target):
                continue
            if not any(reaches(target, b) for b in bound):
                what = f"[{name}] connects to {target}, which no process binds"
                resolved.document.error(what, name, hint=nearest(target, bound, 0.8))


def check_self_subscription(resolved: ResolvedExperiment) -> None:
    """Refuse components that subscribe to themselves: each packet would cause the next."""
    for name, links in resolved.net.links.items():
        own = resolved.net.slots.get(links.publish or "")
        if own is None or resolved.processes[name].role is not Role.COMPONENT:
            continue
        key = f"{own.owner}/{own.use}"
        if key in links.subscribe or (own.address and any(reaches(s, own.address) for s in links.subscribe)):
            resolved.document.error(f"[{name}] subscribes to itself", name, "subscriber")


def check_listens_to(resolved: ResolvedExperiment) -> None:
    """Require that `listens_to` names other components that publish."""
    publishers = {slot.owner for slot in resolved.net.slots.values() if slot.use == "publish"}
    for name, process in resolved.processes.items():
        wanted = process.part.own.get("listens_to", [])
        for i, other in enumerate(wanted if isinstance(wanted, list) else [wanted]):
            path = (name, "listens_to", i)
            if other == name:
                resolved.document.error(f"[{name}] subscribes to itself", *path)
            elif other not in resolved.processes:
                what = f"[{name}] listens_to: there is no component {other!r}"
                resolved.document.error(what, *path, hint=nearest(str(other), publishers))
            elif other not in publishers:
                resolved.document.error(f"[{name}] listens to [{other}], which publishes nothing", *path)


def check_order(resolved: ResolvedExperiment) -> None:
    """Require that `after` names plans that end by themselves, and forms no circle."""
    document, processes = resolved.document, resolved.processes
    scripts = [name for name, one in processes.items() if one.component is not None and _is_script(one.component)]
    for name, process in processes.items():
        if process.after and name not in scripts:
            what = f"[{name}] has `after`, and is no plan: it handles messages from the start on"
            document.error(what, name, "after", hint="only a component with a method `run` begins later")
            continue
        for other in process.after:
            if other not in processes:
                hint = nearest(other, scripts)
                document.error(f"[{name}] after: there is no component {other!r}", name, "after", hint=hint)
            elif other not in scripts:
                document.error(f"[{name}] begins after [{other}], which is no plan, and never done", name, "after")
            elif processes[other].settings.get("end_when_done"):
                what = f"[{name}] begins after [{other}], which ends the experiment when it is done"
                document.error(what, name, "after", hint=f"remove end_when_done of [{other}]")
    if ring := _ring({name: processes[name].after for name in scripts}):
        document.error(f"`after` forms a circle: {' after '.join((*ring, ring[0]))}", ring[0], "after")


def _is_script(component: type) -> bool:
    return issubclass(component, Component) and component.run is not Component.run


def _ring(after: Mapping[str, Sequence[str]]) -> list[str]:
    # a circle, each after the next, from its name that comes first in the file; empty without a circle
    try:
        TopologicalSorter(after).prepare()
    except CycleError as error:
        found: list[str] = error.args[1][:0:-1]  # its last entry repeats the first, and each comes before the next
        start = found.index(next(name for name in after if name in found))
        return found[start:] + found[:start]
    return []


def shared_files(resolved: ResolvedExperiment, names: Collection[str]) -> Iterator[Finding]:
    """Yield an error for a second recorder, and for a component that writes the same file as another.

    Args:
        names: processes that are started together, into one run folder.
    """
    recorders = [name for name in resolved.declaring(RECORDS) if name in names]
    for name in recorders[1:]:
        what = f"[{name}] is a second recorder beside [{recorders[0]}]"
        place = resolved.document.place(name)
        yield Finding(Level.ERROR, what, place, "one is enough: two write the same record, and spoil it")
    written = dict.fromkeys(_OF_EACH_RUN, "")
    for name, process in resolved.processes.items():
        suffix, file = getattr(process.component, FILE_SUFFIX, None), _file_of(process)
        if name not in names or not isinstance(suffix, str) or not isinstance(file, str):
            continue
        other = written.setdefault(f"{file}{suffix}".casefold(), name)
        if other != name:
            by = f"[{other}] writes, too" if other else "afspm writes in every run"
            another = name if suffix else f"{name}{Path(file).suffix}"
            place, hint = resolved.document.place(name, "file"), f'give it a file of its own: file = "{another}"'
            yield Finding(Level.ERROR, f"[{name}] writes {file}{suffix}, which {by}", place, hint)


def _file_of(process: ResolvedProcess) -> object:
    default = None if process.component is None else component_settings.default_of(process.component, "file")
    return process.settings.get("file", default)


def check_problems(resolved: ResolvedExperiment) -> None:
    """Require that all problems exist, and each flagged problem is solved (also by hand) or ends the experiment."""
    control = resolved.sections.control
    by_hand = (*control.solved_by_hand, *control.end_on)
    solvers = (problem for process in resolved.processes.values() for problem in process.declared.solves)
    solved = {_number(resolved, problem) for problem in (*solvers, *by_hand)}
    for name, process in resolved.processes.items():
        for verb, problems in (("solves", process.declared.solves), ("flags", process.declared.flags)):
            for problem in problems:
                number = _number(resolved, problem)
                if number is None:
                    hint = nearest(problem, resolved.problems) + ", or name it under [problems]"
                    resolved.document.error(f"[{name}] {verb} {problem!r}, which is not a problem", name, hint=hint)
                elif verb == "flags" and number not in solved and not control.shadow:
                    what = f"[{name}] flags {problem!r}, which no component solves: the experiment would stand still"
                    hint = "add a component that solves it, or name it in [control] end_on or solved_by_hand"
                    resolved.document.error(what, name, hint=hint)
    for key in ("solved_by_hand", "end_on"):
        for i, problem in enumerate(getattr(control, key)):
            if _number(resolved, problem) is None:
                hint = nearest(problem, resolved.problems)
                resolved.document.error(f"{problem!r} is not a problem", "control", key, i, hint=hint)


def _number(resolved: ResolvedExperiment, problem: str) -> int | None:
    try:
        return resolved.problems.number(problem)
    except InvalidValue:
        return None


def check_envelopes(resolved: ResolvedExperiment) -> None:
    """Require that every envelope subscribed to is published."""
    processes, made = resolved.processes.values(), resolved.caching.envelopes
    declared = [
        message for message in wire.declared() if message.always and message.source in (Role.TRANSLATOR, Role.SCHEDULER)
    ]
    # a foreign translator publishes no conditions: who follows measurements finds their starts in states
    published = {*(message.name for message in declared), CONDITIONS.name, *made}
    published.update(envelope for process in processes for envelope in process.declared.publishes)
    if any(map(_may_publish_lines, resolved.with_role(Role.TRANSLATOR))):
        published.add(SCAN_LINES.name)
        _check_clock_of_lines(resolved)
    for name, process in resolved.processes.items():
        for i, prefix in enumerate(process.envelopes or ()):
            if _is_published(prefix, published, made):
                continue
            key = next((k for k in ("envelopes", "subscriber") if k in process.part.own), "class")
            path = (name, key, i) if key == "envelopes" else (name, key)
            live = SCAN_LINES.name.startswith(prefix)
            shipped = class_loader.shipped_publishers(prefix)
            hint = f"it is published by a {' or a '.join(shipped)}: add it" if shipped else nearest(prefix, published)
            hint = 'give the microscope live_lines_s = "1 s"' if live else hint
            what = f"[{name}] subscribes to {prefix!r}, which no component publishes"
            if resolved.caching.mapping is not None:
                resolved.document.warning(f"{what}, unless the mapping of [cache] makes it", *path, hint=hint)
            else:
                resolved.document.error(what, *path, hint=hint)


def _may_publish_lines(translator: ResolvedProcess) -> bool:
    given = translator.part.settings.get("live_lines_s", getattr(translator.component, "live_real_s", None))
    return bool(translator.part.command or given)


def _check_clock_of_lines(resolved: ResolvedExperiment) -> None:
    # lines are published twice a second of real time, unless the clock waits for their receivers
    clock = resolved.sections.clock
    name = next((one for one, p in resolved.processes.items() if SCAN_LINES.name in (p.envelopes or ())), None)
    if name is not None and clock.speed > FASTEST_WITHOUT_WAIT and not clock.waits:
        resolved.document.warning(
            f"lines of scans may come too late for [{name}], or not at all: the clock does not wait for it",
            "clock",
            "waits",
            hint=f"leave waits out, or set speed = {FASTEST_WITHOUT_WAIT:g} or less",
        )


def _is_published(prefix: str, published: set[str], made: Collection[str]) -> bool:
    # names of scans, spectra, and rules of the cache with {fields} go on after their beginning
    continued = [*(f"{message.name}_" for message in wire.declared() if message.named), *filter(None, made)]
    return any(name.startswith(prefix) for name in published) or prefix.startswith(tuple(continued))


def check_controller(resolved: ResolvedExperiment) -> None:
    """Refuse a second emulated controller; warn of a translator's address that an emulated controller overrides."""
    for name in resolved.emulators[1:]:
        what = f"[{name}] is a second emulated controller beside [{resolved.emulators[0]}]"
        resolved.document.error(what, name, hint="one is enough")
    for translator in resolved.with_role(Role.TRANSLATOR):
        controller = resolved.controller_of(translator.name, resolved.processes)
        if controller and ADDRESS in translator.part.settings:
            what = f"[{translator.name}] {ADDRESS} is not used: it talks to [{controller}], which is emulated"
            hint = f"[{controller}] component = false, for the controller at this address"
            resolved.document.warning(what, translator.name, ADDRESS, hint=hint)


def check_microscope_elsewhere(resolved: ResolvedExperiment) -> None:
    """Refuse a translator that no scheduler commands, and a scheduler whose microscope would be this experiment."""
    for scheduler, advice in _microscope_elsewhere(resolved).items():
        lending = [name for name, process in resolved.processes.items() if _lends_microscope(process)]
        for name in lending:
            what = f"[{name}] acts as the microscope of the scheduler that [{scheduler}] asks: nothing is measured"
            resolved.document.error(what, name, hint=advice)
        for translator in resolved.with_role(Role.TRANSLATOR) if not lending else ():
            what = f"[{translator.name}] is never asked: [{scheduler}] passes all requests on to another scheduler"
            resolved.document.error(what, translator.name, hint=advice)


def _lends_microscope(process: ResolvedProcess) -> bool:
    lends: Callable[[Settings], bool] | None = getattr(process.component, LENDS_MICROSCOPE, None)
    return lends is not None and lends(process.settings)


def check_measures(resolved: ResolvedExperiment) -> None:
    """Warn of an experiment without errors in which no component can ask for a measurement: it would run for ever."""
    if resolved.document.findings.errors or _microscope_elsewhere(resolved):
        return
    if any(_may_measure(one) for one in resolved.with_role(Role.COMPONENT)):
        return
    off = [name for name, table in resolved.parts.intermediaries.items() if table.get("component") is False]
    hint = (
        f"[{off[0]}] component = true"
        if off
        else "add a component that measures, such as a ScanSeries, or the Dashboard"
    )
    resolved.document.warning("nothing measures: no component of this experiment makes requests", hint=hint)


def _may_measure(process: ResolvedProcess) -> bool:
    # a class of the user's own may do anything in its handlers
    if not process.class_path.startswith("afspm.") or process.acts:
        return True
    if any(process.declares(flag) for flag in (OPENS_PLAIN, "has_people", "needs_approval")):
        return True
    # requests need `scope`; components that only read from it count, too, so that the warning is never wrong
    kinds = process.component.__mro__ if process.component is not None else ()
    own = (one for one in kinds if issubclass(one, Component) and one is not Component)
    functions = (getattr(one, "__func__", one) for kind in own for one in vars(kind).values())
    return any("scope" in one.__code__.co_names for one in functions if inspect.isfunction(one))


def check_clock(resolved: ResolvedExperiment) -> None:
    """Refuse simulated time if the microscope is not simulated."""
    has_microscope = bool(resolved.with_role(Role.TRANSLATOR)) or bool(_microscope_elsewhere(resolved))
    if not has_microscope or resolved.simulated:
        return
    if (speed := resolved.sections.clock.speed) != 1.0:
        hint = "a real microscope has real time: remove it, or set it to 1 in the file for this microscope"
        what = f"[clock] speed = {speed:g} on a microscope that is not simulated"
        resolved.document.error(what, "clock", "speed", hint=hint)
    if "start" in resolved.parts.sections.get("clock", {}):
        resolved.document.error("[clock] start on a microscope that is not simulated", "clock", "start")


def check_names_of_people(resolved: ResolvedExperiment) -> None:
    """Require that roles name components, or people with a key."""
    names, keys, security = set(resolved.processes), resolved.keys_folder, resolved.sections.security
    if keys is not None:
        names |= {file.stem for file in (keys / "public").glob("*.key")}
    any_role = False
    for role, members in vars(resolved.sections.control.roles).items():
        for i, member in enumerate(members or ()):
            any_role, path = True, ("control", "roles", role, i)
            if not {member, component_of(member)} & names:
                what = f"[control.roles] {role}: there is no {member!r} among components and keys"
                resolved.document.error(what, *path, hint=nearest(member, names))
            elif not _has_password(resolved, member):
                what = f"[control.roles] {role}: {member!r} has no password: anyone who types the name has the role"
                hint = f"`afspm dashboard --make-password` makes a line of people for [{component_of(member)}]"
                resolved.document.warning(what, *path, hint=hint)
    if any_role and security.insecure:
        hint = "remove [security] insecure, or make keys with `afspm keys` and set [security] keys"
        what = "[control.roles] without keys: any program that takes the name has the role"
        resolved.document.warning(what, "control", "roles", hint=hint)
    for name in resolved.declaring(OPENS_PLAIN):
        if not (security.plain or security.insecure):
            what = f"[{name}] lets programs without keys command the microscope"
            resolved.document.error(what, name, "class", hint="[security] plain = true allows that")
    if keys is not None and not keys.is_dir():
        what = f"[security] keys: there is no folder {str(keys)!r}"
        resolved.document.error(what, "security", "keys", hint="`afspm keys` makes it")


def _has_password(resolved: ResolvedExperiment, member: str) -> bool:
    # a role for a person who has no password at this page would be open to anyone who types the name
    name, _, person = member.partition(PERSON)
    process = resolved.processes.get(name)
    if not person or process is None or not process.declares("has_people"):
        return True
    return person in (process.settings.get("people") or {})


def check_likely_typos(resolved: ResolvedExperiment) -> None:
    """Warn of texts that almost equal a variable's name."""
    known = [*resolved.parts.variables, *resolved.parts.intermediaries]
    for part in resolved.parts.components:
        for path, text in _texts(part.settings, (part.name,)):
            near = closest(text, known, 0.85) if _WORD.fullmatch(text) and len(text) > 3 else None
            if near:
                what = f"[{part.name}] {path[1]} = {text!r} is nearly the name of a variable"
                resolved.document.warning(what, *path, hint=f"did you mean {near!r}?")


def check_replaced_choices(resolved: ResolvedExperiment) -> None:
    """Warn of a variable with the name of a choice of a setting, which the variable replaces."""
    for name, process in resolved.processes.items():
        written = resolved.document.data.get(name, {})
        words = {} if process.component is None else component_settings.choices(process.component)
        for key in written.keys() & words.keys():
            text = written[key]
            if isinstance(text, str) and text in words[key] and text in resolved.parts.variables:
                value = resolved.parts.variables[text]
                what = f"[{name}] {key} = {text!r} is replaced by {value!r}, the value of the variable {text!r}"
                resolved.document.warning(what, name, key, hint="give the variable another name")


def _texts(value: object, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], str]]:
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _texts(item, (*path, key))


def check_needs(resolved: ResolvedExperiment) -> None:
    """Require the parameters of instruments that components need, and those of the microscope and actions if known."""
    of_instruments = tuple(parameter for parameters in resolved.instruments.values() for parameter in parameters)
    for name, process in resolved.processes.items():
        for parameter in filter(is_of_instrument, process.declared.needs_parameters):
            if parameter not in of_instruments:
                what = f"[{name}] needs {parameter!r}, which is a parameter of no instrument"
                resolved.document.error(
                    what, name, hint=nearest(parameter, of_instruments) or "see `parameters` of the instrument"
                )
    for translator in resolved.with_role(Role.TRANSLATOR):
        has = translator.capabilities()
        if has is None:
            continue
        for name, process in resolved.processes.items():
            declared = process.declared
            for kind, needed, offered in (
                ("action", declared.needs_actions, has.actions),
                ("parameter", [*filterfalse(is_of_instrument, declared.needs_parameters)], has.parameters),
            ):
                known = {*offered, *([names.BIAS_OF_SAMPLE] if has.bias.of else [])}
                for missing in [name for name in needed if name not in known]:
                    what = f"[{name}] needs the {kind} {missing!r}, which [{translator.name}] does not have"
                    hint = has.bias.unknown if missing == names.BIAS_OF_SAMPLE else nearest(missing, offered)
                    if missing in names.OF_HELD_Z_ACTIONS:
                        hint = str(getattr(translator.component, "cant_hold_z", hint))
                    resolved.document.error(what, name, hint=hint)


def check_treatments(resolved: ResolvedExperiment) -> None:
    """Warn of treatments of a real tip without limits."""
    translators = resolved.with_role(Role.TRANSLATOR)
    if "limits" in resolved.document.data or all(translator.is_microscope for translator in translators):
        return
    for name, process in resolved.processes.items():
        treatments = [action for action in process.declared.needs_actions if action in names.TREATMENTS]
        if treatments:
            what = f"[{name}] uses {' and '.join(treatments)} on a microscope that is not simulated, without [limits]"
            hint = "bound the voltage and the place: [limits] region = …, parameters = { tip-bias-voltage = … }"
            resolved.document.warning(what, name, hint=hint)


def check_meant_treatments(resolved: ResolvedExperiment) -> None:
    """Warn of pulses and places of treatments that are hardly meant; a limit on pulses says which are meant."""
    for name, plan in resolved.plans.items():
        for number, voltage in enumerate(plan.pulse_voltages):
            if abs(voltage) > _USUAL_PULSE_V and names.PULSE_VOLTAGE not in resolved.limits.parameters:
                what = f"[{name}] pulse_voltages[{number}] is {quantity(voltage, 'V')}: tips are pulsed with some volts"
                hint = f"if it is meant, allow it: [limits.{names.PULSE_VOLTAGE}] min = …, max = …"
                resolved.document.warning(what, name, "pulse_voltages", number, hint=hint)
        for other, scanned in resolved.plans.items():
            place = plan.workshop_center
            if place is not None and any(region.contains(place) for region in scanned.regions):
                what = f"[{name}] workshop_center lies in the region that [{other}] scans"
                hint = "choose a place beside it: pulses and crashes change the sample there"
                resolved.document.warning(what, name, "workshop_center", hint=hint)


def check_reference_scans(resolved: ResolvedExperiment) -> None:
    """Warn of a judge of the tip that learns from all scans of the experiment, and judges none."""
    scans = 0
    for name, process in resolved.processes.items():
        if process.role is not Role.COMPONENT or not process.acts or process.declared.solves:
            continue
        plan = resolved.plans.get(name)
        work = plan.work(None) if plan is not None and plan.work is not None else None
        if work is None or work.scans is None:
            return  # there may be any number of scans
        scans += work.scans
    for name, plan in resolved.plans.items():
        if scans and plan.reference_scans is not None and plan.reference_scans >= scans:
            needed = counted(plan.reference_scans, "scan")
            what = f"[{name}] reference_scans: it judges no scan: it learns from {needed}, and {scans} are planned"
            hint = "plan more scans, or set fewer reference_scans: at least 2, by default 4"
            resolved.document.warning(what, name, "reference_scans", hint=hint)


def check_handlers(resolved: ResolvedExperiment) -> None:
    """Check the names and arguments of methods that look like handlers."""
    for process in resolved.with_role(Role.COMPONENT):
        component = process.component
        if component is None or not issubclass(component, Component):
            continue
        for name, method in _handlers_of(component):
            shown, path = f"[{process.name}] {component.__name__}.{name}", (process.name, "class")
            if hint := _hint_on_handler(name, resolved):
                resolved.document.warning(f"{shown} is never called: there is no such handler", *path, hint=hint)
            wanted = _handler_arguments(name)
            if wrong := _wrong_signature(method, wanted):
                hint = f"write `def {name}({', '.join(wanted)})`"
                resolved.document.error(f"{shown} can't be called with its arguments: {wrong}", *path, hint=hint)


def _handlers_of(component: type[Component]) -> Iterator[tuple[str, Callable[..., object]]]:
    ours = set(Component.__mro__)
    seen: set[str] = set()
    for base in (base for base in component.__mro__ if base not in ours):
        for name, method in vars(base).items():
            if (name == "run" or name.startswith("on_")) and inspect.isfunction(method) and name not in seen:
                seen.add(name)
                yield name, method


def _hint_on_handler(name: str, resolved: ResolvedExperiment) -> str:
    valid = {*_CALLED_METHODS, *(message.handler for message in wire.declared())}
    near = closest(name, valid, _HANDLER_CUTOFF)
    if name in valid or (near is None and resolved.messages):  # a handler of a message of the user's own
        return ""
    return f"did you mean {near!r}?" if near else "on_scan, on_state, …; for a message of your own, named after it"


def _handler_arguments(name: str) -> list[str]:
    base = getattr(Component, name, None)
    return list(inspect.signature(base).parameters) if base is not None else ["self", "message"]


def _wrong_signature(method: Callable[..., object], arguments: list[str]) -> str:
    if inspect.iscoroutinefunction(method) or inspect.isgeneratorfunction(method):
        return "an async function or a generator does nothing when called"
    try:
        inspect.signature(method).bind(*arguments)
    except TypeError as error:
        return str(error)
    return ""


Check = Callable[[ResolvedExperiment], None]
ALWAYS: Final[tuple[Check, ...]] = (
    check_roles,
    check_names,
    check_commands,
    check_intermediaries,
    check_self_subscription,
    check_controller,
    check_microscope_elsewhere,
    check_clock,
    check_names_of_people,
    check_likely_typos,
    check_replaced_choices,
    check_needs,
    check_treatments,
    check_meant_treatments,
    check_reference_scans,
    check_handlers,
    check_notify,
)
CHECKS: Final[tuple[Check, ...]] = (
    *ALWAYS,
    check_addresses,
    check_listens_to,
    check_order,
    check_problems,
    check_envelopes,
    check_measures,
)
