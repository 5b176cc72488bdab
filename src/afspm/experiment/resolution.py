"""From the sorted file to what can be started: classes imported, settings in SI, sections parsed, sockets connected."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

from afspm.basics.errors import AfspmError, InvalidValue, individual_errors
from afspm.client.component import Component
from afspm.experiment import (
    cache_section,
    capabilities,
    class_loader,
    implied_parts,
    limits_section,
    planned_measurements,
    settings,
    validation_messages,
    wiring,
)
from afspm.experiment.capabilities import MicroscopeCapabilities
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.parts import EMULATED, SIMULATED, ExperimentPart, ExperimentParts
from afspm.experiment.planned_measurements import PlannedMeasurements
from afspm.experiment.sections import ExperimentSections, read_sections
from afspm.experiment.toml_lines import Settings, Table
from afspm.experiment.wiring import BoundSocket, Wiring, WiringKeys
from afspm.model import Parameter, ProblemNames, Role
from afspm.scheduler.publishing.envelopes import CacheSettings
from afspm.scheduler.safety.limits import ExperimentLimits

_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
FROM_SECTIONS = ("control", "limits", "cache")
"""Arguments of a scheduler's constructor that come from sections of these names."""
DRIFT = "DriftMapping"
"""Published by a scheduler that corrects drift."""


@dataclass
class ResolvedProcess:
    """One process with all that is known of it before it starts.

    Attributes:
        component: its class, and `class_path` where that is; None and empty for a command, or what can't be loaded.
        settings: as its constructor gets them: in SI, of JSON's types.
        wrong: the settings that were refused; None where all are right.
    """

    part: ExperimentPart
    wires: WiringKeys
    role: Role = Role.COMPONENT
    declared: ComponentDeclaration = field(default_factory=ComponentDeclaration)
    settings: Settings = field(default_factory=dict)
    component: type | None = None
    class_path: str = ""
    wrong: frozenset[str] | None = None

    @property
    def name(self) -> str:
        return self.part.name

    @property
    def acts(self) -> bool:
        """Return whether it follows a plan of its own: a script, unless it solves problems. A command: unknown."""
        if self.component is None or not issubclass(self.component, Component):
            return self.component is None
        return self.component.run is not Component.run and not self.declared.solves

    def says(self, attribute: str) -> bool:
        """Return whether its class has an attribute that is true."""
        return getattr(self.component, attribute, False) is True

    @property
    def is_microscope(self) -> bool:
        """True for a simulated microscope, as its class (a command: its table) says."""
        return self.part.own.get(SIMULATED) is True if self.part.command else self.says(SIMULATED)

    @property
    def envelopes(self) -> tuple[str, ...] | None:
        """The prefixes that it subscribes to: as the file says, else as its class declares; None: all."""
        wanted = self.part.own.get("envelopes", self.wires.envelopes)
        if wanted is None:
            return self.declared.listens
        return (wanted,) if isinstance(wanted, str) else tuple(map(str, wanted))

    def capabilities(self) -> MicroscopeCapabilities | None:
        """Return what a translator can do; None where that is not known before it runs."""
        return None if self.component is None else capabilities.of_class(self.component, self.settings)


@dataclass
class ResolvedExperiment:
    """Everything about the experiment that is known before it starts.

    Attributes:
        processes: by name, in the order of the file.
        listening: where components listen by settings of their own, beside the wiring.
        plans: by component, as far as they are fixed before it runs.
    """

    parts: ExperimentParts
    document: Document
    sections: ExperimentSections
    messages: tuple[str, ...]
    named_problems: dict[str, int]
    processes: dict[str, ResolvedProcess] = field(default_factory=dict)
    net: Wiring = field(default_factory=Wiring)
    listening: list[BoundSocket] = field(default_factory=list)
    limits: ExperimentLimits = field(default_factory=ExperimentLimits)
    caching: CacheSettings = field(default_factory=CacheSettings)
    plans: dict[str, PlannedMeasurements] = field(default_factory=dict)

    @property
    def problems(self) -> ProblemNames:
        return ProblemNames(self.named_problems)

    def error(self, what: str, *path: str | int, hint: str = "") -> None:
        """Report an error at the line where `path` is set."""
        self.document.error(what, *path, hint=hint)

    def warning(self, what: str, *path: str | int, hint: str = "") -> None:
        """Report a warning at the line where `path` is set."""
        self.document.warning(what, *path, hint=hint)

    def with_role(self, role: Role) -> list[ResolvedProcess]:
        return [process for process in self.processes.values() if process.role is role]

    def saying(self, attribute: str) -> list[str]:
        """Return the names of the processes whose class has an attribute that is true."""
        return [name for name, process in self.processes.items() if process.says(attribute)]

    @property
    def keys_folder(self) -> Path | None:
        """The folder of [security] keys, absolute."""
        keys = self.sections.security.keys
        return None if keys is None else self.document.folder_of("security", "keys") / keys

    @property
    def simulated(self) -> bool:
        """True if the microscope is simulated for certain, where all of the file is started on this computer."""
        return self.simulated_with(self.processes)

    def simulated_with(self, started: Collection[str]) -> bool:
        """Return whether the microscope is simulated for certain, where these processes are started together.

        Either the translator is the microscope itself, or it is wired to an emulator that is started with it.
        """
        translators = self.with_role(Role.TRANSLATOR)
        return bool(translators) and all(
            translator.is_microscope or bool(self.controller_of(translator.name, started)) for translator in translators
        )

    def controller_of(self, translator: str, started: Collection[str]) -> str:
        """Return the name of the emulator that a translator is wired to; empty: none that is started with it.

        A translator of another language can't be: nothing proves to whom it talks.
        """
        process = self.processes[translator]
        if process.is_microscope or process.part.command or translator not in started:
            return ""
        return next((name for name in self.emulators if name in started), "")

    @property
    def emulators(self) -> list[str]:
        """The emulated controllers among the components."""
        return self.saying(EMULATED)


def resolve(parts: ExperimentParts, document: Document) -> ResolvedExperiment:
    """Resolve all that can be; what can't is reported and left out."""
    resolved = ResolvedExperiment(
        parts=parts,
        document=document,
        sections=read_sections(parts.sections, document),
        messages=_messages(parts.variables.get("messages", []), document),
        named_problems=_problems(parts.sections.get("problems", {}), document),
    )
    with class_loader.importing_from(document.folders):
        for part in parts.components:
            _add(part, resolved)
        for added in filter(None, (implied_parts.recorder(resolved), implied_parts.notifier(resolved))):
            parts.components.append(added)
            _add(added, resolved)
        _resolve_sections(resolved)
    resolved.net = wiring.connect(resolved.processes, document)
    return resolved


def _add(part: ExperimentPart, resolved: ResolvedExperiment) -> None:
    name, document = part.name, resolved.document
    process = ResolvedProcess(part, wiring.read_wires(part, document))
    resolved.processes[name] = process
    process.declared = ComponentDeclaration.of_table(part.own)
    process.role = _written_role(part, resolved)
    process.settings = settings.jsonable(part.settings, document.folder_of(name))
    if part.command:
        return
    try:
        path = class_loader.full_path(part.class_path)
        component = class_loader.load(path)
    except class_loader.Unloadable as error:
        resolved.document.error(f"[{name}] class: {error.what}", name, "class", hint=error.hint)
        return
    role = class_loader.role_of(component) if isinstance(component, type) else None
    if role is None:
        resolved.document.error(
            f"[{name}] {path} is not a component", name, "class", hint="derive it from afspm.Component"
        )
        return
    process.component, process.class_path, process.role = component, path, role
    process.declared = _declared(component, part)
    errors = document.findings.errors
    given = FROM_SECTIONS if role is Role.SCHEDULER else ()
    wrong: set[str] = set()
    process.settings = settings.check(component, part.settings, (name,), document, given, wrong)
    if document.findings.errors > errors:
        process.wrong = frozenset(wrong)
    for setting, address, keyed in settings.listening(component, process.settings):
        resolved.listening.append(BoundSocket(name, setting, address, setting, document.place(name, setting), keyed))


def _declared(component: type, part: ExperimentPart) -> ComponentDeclaration:
    """Return what the class says; a setting `problem` takes the place of its default there."""
    said = ComponentDeclaration.of_class(component)
    default, given = settings.default_of(component, "problem"), part.settings.get("problem")
    if not isinstance(given, str) or not isinstance(default, str):
        return said

    def put(problems: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(given if problem == default else problem for problem in problems)

    return replace(said, solves=put(said.solves), flags=put(said.flags))


def _resolve_sections(resolved: ResolvedExperiment) -> None:
    """The sections whose meaning depends on the components: what is kept, what is allowed, what is planned."""
    parts, document = resolved.parts, resolved.document
    resolved.caching = cache_section.read(parts.sections.get("cache", {}), document)
    translators = resolved.with_role(Role.TRANSLATOR)
    has = next((has for translator in translators if (has := translator.capabilities())), None)
    reader = limits_section.LimitsReader(
        document,
        components=resolved.processes.keys(),
        parameters=capabilities.base() if has is None else {**capabilities.base(), **has.parameters},
        actions=None if has is None else has.actions,
        sets={} if has is None else has.sets,
        certain=has is not None,
    )
    resolved.limits = reader.read(parts.sections.get("limits", {}))
    for translator in translators:
        for action, reason in planned_measurements.refused_actions(resolved.limits):
            what = f"[{translator.name}] actions: the limits would always refuse {reason}"
            resolved.document.error(what, translator.name, "actions", action)
    for process in resolved.processes.values():
        if process.component is None:
            continue
        if process.wrong is not None:
            _look_inside(process, process.component, resolved)
        else:
            _resolve_plan(process, process.component, resolved, has)
    speeds = [plan.scan_speed_m_s for plan in resolved.plans.values()]
    usual_m_s = next((speed for speed in speeds if speed is not None), None)
    for name, plan in resolved.plans.items():
        if what := planned_measurements.too_slow(plan, usual_m_s):
            resolved.warning(f"[{name}] {what}", name, "every", hint="rounds that come too late are left out")


def _look_inside(process: ResolvedProcess, component: type, resolved: ResolvedExperiment) -> None:
    """Report errors within the tables of a component some of whose other settings are wrong already.

    Only settings that are right as far as was seen count: what does not fit together may do so when others are mended.
    """
    sound = process.settings.keys() - (process.wrong or ())
    try:
        planned_measurements.plan_of(component, process.settings)
    except AfspmError as error:
        for one in individual_errors(error):
            inside = _inside(one)
            if len(inside) > 1 and inside[0] in sound:
                _report(process.name, one, resolved)
    except Exception:  # made of what is wrong, it may fail in any way
        return


def _report(name: str, error: AfspmError, resolved: ResolvedExperiment) -> None:
    inside = _inside(error)
    said = f"{validation_messages.name_of((name, *inside))}{':' if inside else ''} {error.what}"
    resolved.document.error(said, name, *inside, hint=error.hint)


def _inside(error: AfspmError) -> tuple[str | int, ...]:
    """Return where in a component's table an error says that it is: "panel[1].set" as ("panel", 1, "set")."""
    where = error.where.removeprefix("simulation.").removeprefix("the experiment file, ")
    return tuple(int(index) if index else key for key, index in _STEP.findall(where))


def _resolve_plan(
    process: ResolvedProcess, component: type, resolved: ResolvedExperiment, has: MicroscopeCapabilities | None
) -> None:
    """Make a ready-made component once: it knows best whether its settings fit together."""
    name = process.name
    try:
        plan = planned_measurements.plan_of(component, process.settings)
    except AfspmError as error:
        for one in individual_errors(error):
            _report(name, one, resolved)
        return
    except Exception as error:
        resolved.document.error(f"[{name}] refuses its settings: {type(error).__name__}: {error}", name)
        return
    if plan is None:
        return
    process.declared = replace(
        process.declared, needs_actions=plan.needs_actions, needs_parameters=plan.needs_parameters
    )
    resolved.plans[name] = plan
    for refusal in planned_measurements.refusals(name, plan, resolved.limits):
        what = f"[{name}] plans what its limits refuse: {refusal.reason}"
        resolved.document.error(what, name, *refusal.where, hint=refusal.hint)
    if any(DRIFT in scheduler.declared.publishes for scheduler in resolved.with_role(Role.SCHEDULER)):
        for doubt in plan.drift_doubts:
            resolved.document.warning(f"[{name}] {doubt.what}", name, doubt.where, hint=doubt.hint)
    if has is None:
        return
    wanted: list[tuple[tuple[str, ...], Parameter]] = [((name,), one) for one in plan.frame()]
    wanted += [((name, key, one.name), one) for key, given in plan.parameters.items() for one in given]
    for path, parameter in wanted:
        if reason := has.refuses(parameter):
            resolved.document.error(f"[{name}] plans what its microscope refuses: {reason}", *path)


def _written_role(part: ExperimentPart, resolved: ResolvedExperiment) -> Role:
    """By the key `role`, else by the wiring keys that only one role has."""
    written = part.own.get("role")
    if written is not None:
        if written in [role.value for role in Role]:
            return Role(written)
        hint = nearest(str(written), [role.value for role in Role])
        resolved.document.error(f"[{part.name}] has no role {written!r}", part.name, "role", hint=hint)
    if "control_server" in part.own:
        return Role.TRANSLATOR
    return Role.SCHEDULER if {"router", "pubsubcache"} & part.own.keys() else Role.COMPONENT


def _messages(given: object, document: Document) -> tuple[str, ...]:
    """`messages`: .proto files, absolute, and modules with messages of the user."""
    if not isinstance(given, list) or not all(isinstance(one, str) for one in given):
        document.error("`messages` is not a list of texts", "messages", hint='messages = ["my.proto"]')
        return ()
    found = []
    for i, one in enumerate(given):
        if not one.endswith(".proto"):
            found.append(one)
            if class_loader.find_module(one, document.folders) is None:
                document.error(f"messages: there is no module {one!r}", "messages", i, hint="or give a .proto file")
            continue
        file = document.folder_of("messages") / one
        found.append(str(file))
        if not file.is_file():
            hint = "it is looked for beside the experiment file"
            document.error(f"messages: there is no file {one!r}", "messages", i, hint=hint)
    return tuple(found)


def _problems(table: Table, document: Document) -> dict[str, int]:
    """[problems]: each name with its number; a wrong one is reported and left out."""
    named: dict[str, int] = {}
    for name, number in table.items():
        if not isinstance(number, int) or isinstance(number, bool):
            document.error(f"[problems] {name} = {number!r} is not a whole number", "problems", name)
            continue
        try:
            ProblemNames({**named, name: number})
        except InvalidValue as error:
            document.error(error.what, "problems", name, hint=error.hint)
        else:
            named[name] = number
    return named
