"""What must hold between the parts of an experiment: who is there, who talks to whom, who solves what."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator
from typing import Any, Final

from afspm.addresses import EXAMPLE, hint_on, is_address, reaches
from afspm.errors import InvalidValue
from afspm.experiment import notifying, wiring
from afspm.experiment.findings import closest, nearest
from afspm.experiment.handlers import check_handlers
from afspm.experiment.known import WIRE_SETTINGS
from afspm.experiment.published import wire_of
from afspm.experiment.resolution import ResolvedExperiment
from afspm.model import Role, component_of, is_process_name
from afspm.model.events import LONGEST_PROCESS_NAME, PERSON
from afspm.transport.network import is_local

# What translators and schedulers publish by themselves; scans and spectra continue with their kind.
PUBLISHED: Final = (
    "Scan2d",
    "Spec1d",
    "ScopeStateMsg",
    "ControlState",
    "ScanParameters2d",
    "ZCtrlParameters",
    "ProbePosition",
    "JournalEntries",
    "ProcessStates",
    "LogLines",
    "Progress",
)
CONTINUED: Final = ("Scan2d", "Spec1d", "ProcessStates", "Progress")
LIVE: Final = "ScanLines"
"""Published only where it is asked for."""
ADDRESS: Final = "address"
"""By convention the setting of a translator that says where its controller is."""
_WORD = re.compile(r"[A-Za-z_][\w-]*")


def check(resolved: ResolvedExperiment) -> None:
    """Run every check; what is found goes to `resolved.findings`."""
    for one in CHECKS:
        one(resolved)


def check_roles(resolved: ResolvedExperiment) -> None:
    """One scheduler, one translator, and no two names that only differ in upper and lower case."""
    whole = resolved.document.place()
    for role in (Role.SCHEDULER, Role.TRANSLATOR):
        having = resolved.with_role(role)
        if not having and len(resolved.roles) == len(resolved.parts.components) and _all_loaded(resolved):
            hint = {
                Role.SCHEDULER: 'add [scheduler] with component = true and class = "Scheduler"',
                Role.TRANSLATOR: 'add e.g. [microscope] with component = true and class = "Simulator"',
            }[role]
            resolved.findings.error(f"there is no {role.value}", whole, hint)
        for extra in having[1:]:
            resolved.findings.error(
                f"[{extra.name}] is a second {role.value} beside [{having[0].name}]", extra.place, "one is enough"
            )
    seen: dict[str, str] = {}
    for part in resolved.parts.components:
        other = seen.setdefault(part.name.casefold(), part.name)
        if other != part.name:
            resolved.findings.error(
                f"[{part.name}] and [{other}] are the same name but for upper and lower case",
                part.place,
                "their files would be the same on some computers",
            )


def _all_loaded(resolved: ResolvedExperiment) -> bool:
    """A class that can't be loaded may be the one that is looked for."""
    return all(part.command or part.name in resolved.classes for part in resolved.parts.components)


def check_names(resolved: ResolvedExperiment) -> None:
    """A component's name is also that of files, on every system, and of a connection."""
    for part in resolved.parts.components:
        if not is_process_name(part.name):
            resolved.findings.error(
                f"[{part.name}] can't be the name of a component",
                part.place,
                f"letters, digits, _, - and spaces, at most {LONGEST_PROCESS_NAME} bytes, as in [tip_corrector]",
            )


def check_commands(resolved: ResolvedExperiment) -> None:
    """The program of a command can be found."""
    for part in resolved.parts.components:
        if part.command and not notifying.is_program(part.command[0], resolved.document.folders[0]):
            resolved.findings.error(
                f"[{part.name}] there is no program {part.command[0]!r}",
                resolved.document.place(part.name, "command"),
                "give its path, or install it",
            )


def check_intermediaries(resolved: ResolvedExperiment) -> None:
    """Each intermediary table of a known kind has settings that the kind knows, and addresses where they belong."""
    names = [*resolved.parts.variables, *resolved.parts.intermediaries]
    for name, table in resolved.parts.intermediaries.items():
        kind = wire_of(table)
        if kind is None:
            continue
        for key, value in table.items():
            place = resolved.document.place(name, key)
            if key != "class" and key not in WIRE_SETTINGS[kind]:
                hint = nearest(key, WIRE_SETTINGS[kind])
                resolved.findings.error(f"[{name}] a {kind.value} has no setting {key!r}", place, hint)
            elif key in ("request_timeout_ms", "request_retries") and not isinstance(value, int | float):
                hint = "is it in a second file, to be laid over this one?"
                resolved.findings.error(f"[{name}] {key} = {value!r} is no number", place, hint)
            elif key.endswith("url"):
                for url in value if isinstance(value, list) else [value]:
                    if not isinstance(url, str) or not is_address(url):
                        near = closest(str(url), names, 0.7)
                        hint = f"did you mean {near!r}?" if near else hint_on(str(url)) or EXAMPLE
                        resolved.findings.error(f"[{name}] {key} = {url!r} is not an address", place, hint)


def check_addresses(resolved: ResolvedExperiment) -> None:
    """No address is bound twice; none is open to the network without keys; every connection has somebody at its end."""
    bound: dict[str, wiring.BoundSocket] = {}
    secure = resolved.security.keys is not None or resolved.security.insecure
    for slot in (*resolved.net.slots.values(), *resolved.listening):
        if slot.address is None:
            continue
        for address, other in bound.items():
            if reaches(slot.address, address) or reaches(address, slot.address):
                resolved.findings.error(
                    f"[{slot.owner}] and [{other.owner}] both bind {slot.address} ({slot.use}, {other.use})", slot.place
                )
        bound[slot.address] = slot
        if slot.keyed and is_address(slot.address) and not is_local(slot.address) and not secure:
            resolved.findings.error(
                f"[{slot.owner}] binds {slot.address}, which other computers can reach, without keys",
                slot.place,
                'make keys with `afspm keys` and set [security] keys = "keys"; or say [security] insecure = true',
            )
    if not all(is_address(address) for address in bound):
        return  # what is no address has been reported as such; whoever looks for it may be right
    for name, links in resolved.net.links.items():
        for target in (links.control, *links.subscribe):
            if target is None or target in resolved.net.slots or not is_address(target):
                continue
            if not any(reaches(target, b) for b in bound):
                resolved.findings.error(
                    f"[{name}] connects to {target}, which nobody binds",
                    resolved.document.place(name),
                    nearest(target, bound, 0.8),
                )


def check_self_subscription(resolved: ResolvedExperiment) -> None:
    """Nobody listens to itself: each packet would be the cause of the next."""
    for name, links in resolved.net.links.items():
        own = resolved.net.slots.get(links.publish or "")
        if own is None or resolved.roles[name] is not Role.COMPONENT:
            continue
        key = f"{own.owner}/{own.use}"
        if key in links.subscribe or (own.address and any(reaches(s, own.address) for s in links.subscribe)):
            resolved.findings.error(f"[{name}] subscribes to itself", resolved.document.place(name, "subscriber"))


def check_listens_to(resolved: ResolvedExperiment) -> None:
    """`listens_to` names others that publish."""
    publishers = {slot.owner for slot in resolved.net.slots.values() if slot.use == "publish"}
    for part in resolved.parts.components:
        wanted = part.own.get("listens_to", [])
        for i, other in enumerate(wanted if isinstance(wanted, list) else [wanted]):
            place = resolved.document.place(part.name, "listens_to", i)
            if other == part.name:
                resolved.findings.error(f"[{part.name}] subscribes to itself", place)
            elif other not in resolved.roles:
                resolved.findings.error(
                    f"[{part.name}] listens_to: there is no component {other!r}", place, nearest(str(other), publishers)
                )
            elif other not in publishers:
                resolved.findings.error(f"[{part.name}] listens to [{other}], which publishes nothing", place)


def check_problems(resolved: ResolvedExperiment) -> None:
    """Problems named by components exist, and each that is flagged is solved by somebody."""
    solved = {_number(resolved, p) for said in resolved.declared.values() for p in said.solves}
    solved |= {_number(resolved, p) for p in resolved.control.solved_by_hand}
    for name, said in resolved.declared.items():
        place = resolved.document.place(name)
        for verb, problems in (("solves", said.solves), ("flags", said.flags)):
            for problem in problems:
                number = _number(resolved, problem)
                if number is None:
                    hint = nearest(problem, resolved.problems) + ", or name it under [problems]"
                    resolved.findings.error(f"[{name}] {verb} {problem!r}, which is no problem", place, hint)
                elif verb == "flags" and number not in solved:
                    resolved.findings.error(
                        f"[{name}] flags {problem!r}, which nobody solves: the experiment would stand still",
                        place,
                        "add a component that solves it, or [control] solved_by_hand",
                    )
    for i, problem in enumerate(resolved.control.solved_by_hand):
        if _number(resolved, problem) is None:
            place = resolved.document.place("control", "solved_by_hand", i)
            resolved.findings.error(f"{problem!r} is no problem", place, nearest(problem, resolved.problems))


def _number(resolved: ResolvedExperiment, problem: str) -> int | None:
    try:
        return resolved.problems.number(problem)
    except InvalidValue:
        return None


def check_envelopes(resolved: ResolvedExperiment) -> None:
    """Every envelope subscribed to is published by somebody."""
    published = {*PUBLISHED, *(e for said in resolved.declared.values() for e in said.publishes)}
    published |= set(resolved.caching.envelopes)
    if any(part.command or part.settings.get("live_lines_s") for part in resolved.with_role(Role.TRANSLATOR)):
        published.add(LIVE)
    for part in resolved.parts.components:
        for i, prefix in enumerate(resolved.envelopes(part) or ()):
            key = next((k for k in ("envelopes", "subscriber") if k in part.own), "class")
            place = resolved.document.place(part.name, key, *([i] if key == "envelopes" else []))
            if _is_published(prefix, published, resolved.caching.envelopes):
                continue
            live = LIVE.startswith(prefix)
            hint = 'give the microscope live_lines_s = "1 s"' if live else nearest(prefix, published)
            what = f"[{part.name}] subscribes to {prefix!r}, which nobody publishes"
            if resolved.caching.mapping is not None:
                resolved.findings.warning(what + ", unless the mapping of [cache] makes it", place, hint)
            else:
                resolved.findings.error(what, place, hint)


def _is_published(prefix: str, published: set[str], made: Collection[str]) -> bool:
    """A prefix fits what it begins; scans, spectra and what rules of the cache fill in go on behind their beginning."""
    return any(name.startswith(prefix) for name in published) or any(
        prefix.startswith(start) for start in (*(f"{name}_" for name in CONTINUED), *filter(None, made))
    )


def check_controller(resolved: ResolvedExperiment) -> None:
    """One emulated controller at most, and no other address for its translator."""
    for name in resolved.emulators[1:]:
        what = f"[{name}] is a second emulated controller beside [{resolved.emulators[0]}]"
        resolved.findings.error(what, resolved.document.place(name), "one is enough")
    names = [part.name for part in resolved.parts.components]
    for part in resolved.with_role(Role.TRANSLATOR):
        controller = resolved.controller_of(part.name, names)
        if controller and ADDRESS in part.settings:
            resolved.findings.warning(
                f"[{part.name}] {ADDRESS} is not used: it talks to [{controller}], which is emulated",
                resolved.document.place(part.name, ADDRESS),
                f"[{controller}] component = false, for the controller at this address",
            )


def check_clock(resolved: ResolvedExperiment) -> None:
    """Only a simulation's time may be other than real."""
    table = resolved.parts.sections.get("clock", {})
    if not resolved.with_role(Role.TRANSLATOR) or resolved.simulated:
        return
    if resolved.clock.speed != 1.0:
        resolved.findings.error(
            f"[clock] speed = {resolved.clock.speed:g} on a microscope that is not simulated",
            resolved.document.place("clock", "speed"),
            "time can't be made faster there: leave it out, or set it to 1 in the file for this microscope",
        )
    if "start" in table:
        resolved.findings.error(
            "[clock] start on a microscope that is not simulated", resolved.document.place("clock", "start")
        )


def check_names_of_people(resolved: ResolvedExperiment) -> None:
    """Roles name components, or people who have a key."""
    names = {part.name for part in resolved.parts.components}
    keys = resolved.keys_folder
    if keys is not None:
        names |= {file.stem for file in (keys / "public").glob("*.key")}
    any_role = False
    for role, members in resolved.control.roles:
        for i, member in enumerate(members or ()):
            any_role = True
            if not {member, component_of(member)} & names:
                place = resolved.document.place("control", "roles", role, i)
                what = f"[control.roles] {role}: there is no {member!r} among components and keys"
                resolved.findings.error(what, place, nearest(member, names))
            elif not _has_password(resolved, member):
                resolved.findings.warning(
                    f"[control.roles] {role}: {member!r} has no password, whoever types the name has the role",
                    resolved.document.place("control", "roles", role, i),
                    f"`afspm dashboard --make-password` makes a line of people for [{component_of(member)}]",
                )
    if any_role and (resolved.security.plain or resolved.security.insecure):
        resolved.findings.warning(
            "[control.roles] without keys: whoever takes the name has the role",
            resolved.document.place("control", "roles"),
            "leave [security] plain away, or make keys with `afspm keys` and set [security] keys",
        )
    if keys is not None and not keys.is_dir():
        resolved.findings.error(
            f"[security] keys: there is no folder {str(keys)!r}", resolved.document.place("security", "keys"),
            "`afspm keys` makes it"
        )  # fmt: skip


def _has_password(resolved: ResolvedExperiment, member: str) -> bool:
    """False for a person of a dashboard that does not know the password of this person."""
    component, _, person = member.partition(PERSON)
    operates = getattr(resolved.classes.get(component), "operates", False) is True
    return not (person and operates) or person in (resolved.settings[component].get("people") or {})


def check_likely_typos(resolved: ResolvedExperiment) -> None:
    """A text that is nearly a variable's name was probably meant to be it."""
    names = [*resolved.parts.variables, *resolved.parts.intermediaries]
    for part in resolved.parts.components:
        for path, text in _texts(part.settings, (part.name,)):
            near = closest(text, names, 0.85) if _WORD.fullmatch(text) and len(text) > 3 else None
            if near:
                resolved.findings.warning(
                    f"[{part.name}] {path[1]} = {text!r} is nearly the name of a variable",
                    resolved.document.place(*path),
                    f"did you mean {near!r}?",
                )


def _texts(value: Any, path: tuple[str | int, ...]) -> Iterator[tuple[tuple[str | int, ...], str]]:
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _texts(item, (*path, key))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _texts(item, (*path, i))


def check_needs(resolved: ResolvedExperiment) -> None:
    """The microscope has the actions and parameters that components say they need, where it tells before it runs."""
    for part in resolved.with_role(Role.TRANSLATOR):
        has = resolved.abilities(part)
        if has is None:
            continue
        for name, said in resolved.declared.items():
            for kind, needed, offered in (
                ("action", said.needs_actions, has.actions),
                ("parameter", said.needs_parameters, has.parameters),
            ):
                for one in needed:
                    if one not in offered:
                        resolved.findings.error(
                            f"[{name}] needs the {kind} {one!r}, which [{part.name}] does not have",
                            resolved.document.place(name),
                            nearest(one, offered),
                        )


CHECKS: Final[tuple[Callable[[ResolvedExperiment], None], ...]] = (
    check_roles,
    check_names,
    check_commands,
    check_intermediaries,
    check_addresses,
    check_self_subscription,
    check_listens_to,
    check_problems,
    check_envelopes,
    check_controller,
    check_clock,
    check_names_of_people,
    check_likely_typos,
    check_needs,
    check_handlers,
    notifying.check,
)
