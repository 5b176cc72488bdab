"""From the sorted file to what can be started: classes imported, settings in SI, sections parsed, sockets connected."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from afspm.errors import AfspmError, InvalidValue, individual_errors
from afspm.experiment import (
    cache_section,
    capabilities,
    class_loader,
    limits_section,
    notifying,
    planned_measurements,
    recording,
    sections,
    settings,
    wiring,
)
from afspm.experiment.cache_section import CacheSettings
from afspm.experiment.capabilities import MicroscopeCapabilities
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.experiment.document import Document
from afspm.experiment.findings import Findings, nearest
from afspm.experiment.parts import EMULATED, SIMULATED, ExperimentPart, ExperimentParts
from afspm.experiment.wiring import BoundSocket, Wiring, WiringKeys
from afspm.logic.limits import ExperimentLimits
from afspm.model import ProblemNames, Role

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
FROM_SECTIONS = ("control", "limits", "cache")
"""Arguments of a scheduler's constructor that come from sections of these names."""


@dataclass
class ResolvedExperiment:
    """Everything about the experiment that is known before it starts. Mappings are by the component's name."""

    parts: ExperimentParts
    document: Document
    findings: Findings
    clock: sections.ClockSection
    control: sections.ControlSection
    security: sections.SecuritySection
    messages: tuple[str, ...]
    restart: sections.RestartSection
    notify: sections.NotifySection
    problems: ProblemNames
    named_problems: dict[str, int]
    refused: dict[str, frozenset[str]] = field(default_factory=dict)
    """Of those whose settings are wrong: which of them."""
    classes: dict[str, type] = field(default_factory=dict)
    class_paths: dict[str, str] = field(default_factory=dict)
    roles: dict[str, Role] = field(default_factory=dict)
    declared: dict[str, ComponentDeclaration] = field(default_factory=dict)
    settings: dict[str, dict[str, Any]] = field(default_factory=dict)
    wires: dict[str, WiringKeys] = field(default_factory=dict)
    net: Wiring = field(default_factory=Wiring)
    listening: list[BoundSocket] = field(default_factory=list)
    """Where components listen by settings of their own, beside the wiring."""
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    caching: CacheSettings = field(default_factory=CacheSettings)

    def with_role(self, role: Role) -> list[ExperimentPart]:
        return [part for part in self.parts.components if self.roles.get(part.name) is role]

    @property
    def keys_folder(self) -> Path | None:
        """The folder of [security] keys, absolute."""
        keys = self.security.keys
        return None if keys is None else self.document.folder_of("security", "keys") / keys

    def envelopes(self, part: ExperimentPart) -> tuple[str, ...] | None:
        """The prefixes a component subscribes to: as the file says, else as its class declares; None: all."""
        wanted = part.own.get("envelopes", self.wires[part.name].envelopes)
        if wanted is None:
            return self.declared[part.name].listens
        return (wanted,) if isinstance(wanted, str) else tuple(map(str, wanted))

    def abilities(self, part: ExperimentPart) -> MicroscopeCapabilities | None:
        """What a translator can do; None where that is not known before it runs."""
        microscope = self.classes.get(part.name)
        return None if microscope is None else capabilities.of_class(microscope, self.settings[part.name])

    @property
    def simulated(self) -> bool:
        """True if the microscope is simulated for certain, where all of the file is started on this computer."""
        return self.simulated_with([part.name for part in self.parts.components])

    def simulated_with(self, started: Collection[str]) -> bool:
        """True if the microscope is simulated for certain, where these processes are started together.

        Either the translator is the microscope itself, as its class (a command: its table) says, or it is wired to an
        emulator that is started with it.
        """
        translators = self.with_role(Role.TRANSLATOR)
        return bool(translators) and all(
            self._is_the_microscope(part) or bool(self.controller_of(part.name, started)) for part in translators
        )

    def controller_of(self, translator: str, started: Collection[str]) -> str:
        """The name of the emulator that a translator is wired to; empty: none that is started with it.

        A translator of another language can't be: nothing proves to whom it talks.
        """
        part = next(part for part in self.parts.components if part.name == translator)
        if self._is_the_microscope(part) or part.command or translator not in started:
            return ""
        return next((name for name in self.emulators if name in started), "")

    @property
    def emulators(self) -> list[str]:
        """The emulated controllers among the components."""
        return [part.name for part in self.parts.components if self._says(part, EMULATED)]

    def _is_the_microscope(self, part: ExperimentPart) -> bool:
        return part.own.get(SIMULATED) is True if part.command else self._says(part, SIMULATED)

    def _says(self, part: ExperimentPart, attribute: str) -> bool:
        return getattr(self.classes.get(part.name), attribute, False) is True


def resolve(parts: ExperimentParts, document: Document, findings: Findings) -> ResolvedExperiment:
    """Resolve all that can be; what can't is reported and left out."""

    def section(model: type[sections.S], name: str) -> sections.S:
        return sections.parse(model, name, parts.sections.get(name, {}), document, findings)

    named = _problems(parts.sections.get("problems", {}), document, findings)
    resolved = ResolvedExperiment(
        parts=parts,
        document=document,
        findings=findings,
        clock=section(sections.ClockSection, "clock"),
        control=section(sections.ControlSection, "control"),
        security=section(sections.SecuritySection, "security"),
        messages=_messages(parts.variables.get("messages", []), document, findings),
        restart=section(sections.RestartSection, "restart"),
        notify=section(sections.NotifySection, "notify"),
        problems=ProblemNames(named),
        named_problems=named,
    )
    for part in parts.components:
        resolved.wires[part.name] = wiring.read_wires(part, document.place, findings)
    with class_loader.importing_from(document.folders):
        for part in parts.components:
            _resolve_part(part, resolved)
        recorder = recording.implied(resolved, section(sections.RecordSection, "record"))
        notifier = notifying.implied(resolved, resolved.notify)
        for added in filter(None, (recorder, notifier)):
            parts.components.append(added)
            resolved.wires[added.name] = wiring.read_wires(added, document.place, findings)
            _resolve_part(added, resolved)
        _resolve_sections(resolved)
    resolved.net = wiring.connect(parts.components, resolved.roles, resolved.declared, resolved.wires, document.place)
    return resolved


def _resolve_part(part: ExperimentPart, resolved: ResolvedExperiment) -> None:
    name, document, findings = part.name, resolved.document, resolved.findings
    resolved.declared[name] = ComponentDeclaration.of_table(part.own)
    resolved.roles[name] = _written_role(part, resolved)
    resolved.settings[name] = settings.jsonable(part.settings, document.folder_of(name))
    if part.command:
        return
    try:
        path = class_loader.full_path(part.class_path)
        component = class_loader.load(path)
    except class_loader.Unloadable as error:
        findings.error(f"[{name}] class: {error.what}", document.place(name, "class"), error.hint)
        return
    role = class_loader.role_of(component) if isinstance(component, type) else None
    if role is None:
        findings.error(
            f"[{name}] {path} is not a component",
            document.place(name, "class"),
            "derive it from afspm.Component",
        )
        return
    resolved.classes[name], resolved.class_paths[name], resolved.roles[name] = component, path, role
    resolved.declared[name] = _declared(component, part)
    errors = findings.errors
    given = FROM_SECTIONS if role is Role.SCHEDULER else ()
    wrong: set[str] = set()
    resolved.settings[name] = settings.check(component, part.settings, (name,), document, findings, given, wrong)
    if findings.errors > errors:
        resolved.refused[name] = frozenset(wrong)
    for setting, address, keyed in settings.listening(component, resolved.settings[name]):
        resolved.listening.append(BoundSocket(name, setting, address, setting, document.place(name, setting), keyed))


def _declared(component: type, part: ExperimentPart) -> ComponentDeclaration:
    """What the class says; a setting `problem` takes the place of its default there."""
    said = ComponentDeclaration.of_class(component)
    default, given = settings.default_of(component, "problem"), part.settings.get("problem")
    if not isinstance(given, str) or not isinstance(default, str):
        return said

    def put(problems: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(given if problem == default else problem for problem in problems)

    return replace(said, solves=put(said.solves), flags=put(said.flags))


def _resolve_sections(resolved: ResolvedExperiment) -> None:
    """The sections whose meaning depends on the components: what is kept, what is allowed, what is planned."""
    parts, document, findings = resolved.parts, resolved.document, resolved.findings
    logic = next((wires.cache_logic for wires in resolved.wires.values() if wires.cache_logic), None)
    resolved.caching = cache_section.read(parts.sections.get("cache", {}), logic, document, findings)
    has = next((has for part in resolved.with_role(Role.TRANSLATOR) if (has := resolved.abilities(part))), None)
    reader = limits_section.LimitsReader(
        document,
        findings,
        components=tuple(part.name for part in parts.components),
        parameters=capabilities.base() if has is None else {**capabilities.base(), **has.parameters},
        actions=None if has is None else has.actions,
        certain=has is not None,
        sets={} if has is None else has.sets,
    )
    resolved.limits = reader.read(parts.sections.get("limits", {}))
    for part in resolved.with_role(Role.TRANSLATOR):
        for action, reason in planned_measurements.refused_actions(resolved.limits):
            place = document.place(part.name, "actions", action)
            findings.error(f"[{part.name}] actions: the limits would always refuse {reason}", place)
    for part in parts.components:
        if part.name in resolved.refused:
            _look_inside(part.name, resolved)
        elif part.name in resolved.classes:
            _resolve_plan(part.name, resolved)


def _look_inside(name: str, resolved: ResolvedExperiment) -> None:
    """What is wrong within the tables of a component some of whose other settings are wrong already.

    Only that counts which lies within a setting of the file that is right as far as was seen: what does not fit
    together may do so when the others are mended.
    """
    sound = resolved.settings[name].keys() - resolved.refused[name]
    try:
        planned_measurements.plan_of(resolved.classes[name], resolved.settings[name])
    except AfspmError as error:
        for one in individual_errors(error):
            inside = _inside(one)
            if len(inside) > 1 and inside[0] in sound:
                _report(name, one, resolved)
    except Exception:  # made of what is wrong, it may fail in any way
        return


def _report(name: str, error: AfspmError, resolved: ResolvedExperiment) -> None:
    inside = _inside(error)
    said = f"{sections.name_of((name, *inside))}{':' if inside else ''} {error.what}"
    resolved.findings.error(said, resolved.document.place(name, *inside), error.hint)


def _inside(error: AfspmError) -> tuple[str | int, ...]:
    """Where in a component's table an error says that it is: "panel[1].set" as ("panel", 1, "set")."""
    where = error.where.removeprefix("simulation.").removeprefix("the experiment file, ")
    return tuple(int(index) if index else key for key, index in _STEP.findall(where))


def _resolve_plan(name: str, resolved: ResolvedExperiment) -> None:
    """A ready-made component is made once: it knows best whether its settings fit together."""
    place = resolved.document.place(name)
    try:
        plan = planned_measurements.plan_of(resolved.classes[name], resolved.settings[name])
    except AfspmError as error:
        for one in individual_errors(error):
            _report(name, one, resolved)
        return
    except Exception as error:
        resolved.findings.error(f"[{name}] refuses its settings: {type(error).__name__}: {error}", place)
        return
    if plan is None:
        return
    resolved.declared[name] = replace(
        resolved.declared[name], needs_actions=plan.needs_actions, needs_parameters=plan.needs_parameters
    )
    for reason in planned_measurements.refusals(name, plan, resolved.limits):
        resolved.findings.error(f"[{name}] plans what its limits refuse: {reason}", place)


def _written_role(part: ExperimentPart, resolved: ResolvedExperiment) -> Role:
    """By the key `role`, else by the wiring keys that only one role has."""
    written = part.own.get("role")
    if written is not None:
        if written in [role.value for role in Role]:
            return Role(written)
        resolved.findings.error(
            f"[{part.name}] has no role {written!r}",
            resolved.document.place(part.name, "role"),
            nearest(str(written), [role.value for role in Role]),
        )
    if "control_server" in part.own:
        return Role.TRANSLATOR
    return Role.SCHEDULER if {"router", "pubsubcache"} & part.own.keys() else Role.COMPONENT


def _messages(given: Any, document: Document, findings: Findings) -> tuple[str, ...]:
    """`messages`: .proto files, absolute, and modules with messages of the user."""
    if not isinstance(given, list) or not all(isinstance(one, str) for one in given):
        findings.error("`messages` is not a list of texts", document.place("messages"), 'messages = ["my.proto"]')
        return ()
    found = []
    for i, one in enumerate(given):
        place = document.place("messages", i)
        if not one.endswith(".proto"):
            found.append(one)
            if class_loader.find_module(one, document.folders) is None:
                findings.error(f"messages: there is no module {one!r}", place, "or give a .proto file")
            continue
        file = document.folder_of("messages") / one
        found.append(str(file))
        if not file.is_file():
            findings.error(f"messages: there is no file {one!r}", place, "it is looked for beside the experiment file")
    return tuple(found)


def _problems(table: Mapping[str, Any], document: Document, findings: Findings) -> dict[str, int]:
    """[problems]: each name with its number; a wrong one is reported and left out."""
    named: dict[str, int] = {}
    for name, number in table.items():
        place = document.place("problems", name)
        if not isinstance(number, int) or isinstance(number, bool):
            findings.error(f"[problems] {name} = {number!r} is not a whole number", place)
            continue
        try:
            ProblemNames({**named, name: number})
        except InvalidValue as error:
            findings.error(error.what, place, error.hint)
        else:
            named[name] = number
    return named
