"""Resolution of the sorted file: classes imported, settings in SI, sections parsed, sockets connected."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import replace

from afspm import wire
from afspm.basics.errors import AfspmError, InvalidValue, individual_errors
from afspm.experiment import (
    capabilities,
    class_loader,
    component_settings,
    conditions_section,
    default_limits,
    implied_parts,
    limits_section,
    planned_measurements,
    validation_messages,
    wiring,
)
from afspm.experiment.capabilities import MicroscopeCapabilities
from afspm.experiment.class_loader import ComponentDeclaration
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.parts import ExperimentPart, ExperimentParts
from afspm.experiment.resolved_experiment import ResolvedExperiment, ResolvedProcess
from afspm.experiment.sections import parse, read_sections
from afspm.experiment.toml_lines import Table
from afspm.experiment.wiring_classes import BoundSocket
from afspm.model import STOPPED_BY_AGENT, ChannelRoles, PacketHeader, Parameter, ProblemNames, Role, names
from afspm.model.bias import BiasReference
from afspm.model.problems import HIGHEST_PROBLEM, QUIET_HOURS
from afspm.scheduler.publishing.envelopes import CacheSettings, Envelopes

_WORDS = re.compile(r"[\w-]+")
_STEP = re.compile(r"([^.\[\]]+)|\[(\d+)\]")
FROM_SECTIONS = ("control", "limits", "cache", "conditions")
"""Arguments of a scheduler's constructor, filled from the sections of these names."""
_EXAMPLE_HEADERS = (
    PacketHeader("Scan2d", "Height", (1e-6, 1e-6)),
    PacketHeader("Spec1d", kind="IV"),
    *(
        PacketHeader(message.name)
        for message in wire.declared()
        if message.kind is wire.MessageKind.STATE and message.source is Role.TRANSLATOR
    ),
)
"""Packet headers for a trial of the user's mapping from packets to envelopes."""
DRIFT = "DriftMapping"
"""Envelope that a drift-correcting scheduler publishes."""


def resolve(parts: ExperimentParts, document: Document) -> ResolvedExperiment:
    """Resolve the experiment, and report errors. A process whose class can't be loaded stays, without class."""
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
        for added in implied_parts.complete(resolved):
            parts.components.append(added)
            _add(added, resolved)
        _resolve_sections(resolved)
    resolved.net = wiring.wire(resolved.processes, document)
    return resolved


def _add(part: ExperimentPart, resolved: ResolvedExperiment) -> None:
    name, document = part.name, resolved.document
    process = ResolvedProcess(part, wiring.read_wires(part, document))
    resolved.processes[name] = process
    process.declared = ComponentDeclaration.of_table(part.own)
    process.role = _written_role(part, resolved)
    process.settings = {
        key: component_settings.jsonable(value, document.folder_of(name, key)) for key, value in part.settings.items()
    }
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
    process.settings = component_settings.resolve(component, part.settings, (name,), document, given, wrong)
    if document.findings.errors > errors:
        process.wrong = frozenset(wrong)
    for setting, address, keyed in component_settings.listening(component, process.settings):
        resolved.listening.append(BoundSocket(name, setting, address, setting, document.place(name, setting), keyed))


def _declared(component: type, part: ExperimentPart) -> ComponentDeclaration:
    # a setting `problem` replaces its default value in what the class solves and flags
    declaration = ComponentDeclaration.of_class(component)
    default, given = component_settings.default_of(component, "problem"), part.settings.get("problem")
    if not isinstance(given, str) or not isinstance(default, str):
        return declaration

    def put(problems: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(given if problem == default else problem for problem in problems)

    return replace(declaration, solves=put(declaration.solves), flags=put(declaration.flags))


def _resolve_sections(resolved: ResolvedExperiment) -> None:
    parts, document = resolved.parts, resolved.document
    resolved.caching = _cache_section(parts.sections.get("cache", {}), document)
    translators = resolved.with_role(Role.TRANSLATOR)
    has = next((has for translator in translators if (has := translator.capabilities())), None)
    reader = limits_section.LimitsReader(
        document,
        components=resolved.processes.keys(),
        parameters={**capabilities.base(), **({} if has is None else has.parameters), names.BIAS_OF_SAMPLE: "V"},
        bias=next((capabilities.bias_given(translator.settings) for translator in translators), BiasReference())
        if has is None
        else has.bias,
        instruments=resolved.instruments,
        actions=None if has is None else has.actions,
        sets={} if has is None else has.sets,
        certain=has is not None,
        coarse={} if has is None else has.coarse,
        lacking=frozenset() if has is None else frozenset(names.BASE_PARAMETERS) - has.parameters.keys(),
        types={}
        if has is None
        else {name: has.table[name].type for name in has.table if not has.table[name].is_number},
    )
    if resolved.declaring("needs_approval") or resolved.sections.control.agents:
        resolved.named_problems.setdefault(STOPPED_BY_AGENT, HIGHEST_PROBLEM)
    if any(QUIET_HOURS in process.declared.flags for process in resolved.processes.values()):
        resolved.named_problems.setdefault(QUIET_HOURS, HIGHEST_PROBLEM - 1)
    limits_table = parts.sections.get("limits", {})
    resolved.limits = reader.read(limits_table)
    for translator in translators:
        if (file := getattr(translator.component, "limits_file", None)) is not None:
            resolved.default_limits = default_limits.read(file, reader, limits_table)
    resolved.limits = default_limits.merged(resolved.limits, resolved.default_limits, limits_table, document)
    resolved.conditions = conditions_section.ConditionsReader(
        document, resolved.instruments, reader.actions, resolved.problems
    ).read(parts.sections.get("conditions", {}))
    lateral = [name for name, one in resolved.limits.movers.movers.items() if one.direction == "lateral"]
    for name in lateral if _corrects_drift(resolved) else ():
        what = f"[limits.movers] {name} moves the sample along, and sample coordinates of before do not hold after it"
        hint = 'take the scheduler without drift correction: class = "Scheduler"'
        document.error(what, "limits", "movers", name, hint=hint)
    for translator in translators:
        for action, reason in planned_measurements.refused_actions(resolved.limits):
            what = f"[{translator.name}] actions: the limits would always refuse {reason}"
            resolved.document.error(what, translator.name, "actions", action)
        there = translator.capabilities()
        for action, (reason, hint) in () if there is None else there.refused_commands.items():
            what = f"[{translator.name}] actions.{action}: {reason}"
            resolved.document.error(what, translator.name, "actions", action, hint=hint)
        given = translator.settings.get("actions") or {}
        for action in (one for one in resolved.limits.movers.undeclared if one in given):
            what = f"[{translator.name}] actions.{action} moves the coarse motor, and is refused until it is a mover"
            hint = f'[limits.movers] {action} = {{ direction = "lateral", steps = 10, total = 500 }}'
            resolved.warning(what, translator.name, "actions", action, hint=hint)
        for action in () if there is None else there.never_withdrawn:
            what = f"[{translator.name}] actions.{action}: it needs a withdrawn tip, which this microscope never shows"
            hint = "leave it out, and do it by hand after `afspm pause`"
            resolved.document.error(what, translator.name, "actions", action, hint=hint)
    for process in resolved.processes.values():
        if process.component is None:
            continue
        if process.wrong is not None:
            _report_errors_inside(process, process.component, resolved)
            _report_errors_beside(process, process.component, process.wrong, resolved)
        else:
            _resolve_plan(process, process.component, resolved, has)
        if has is not None:
            _check_channels(process, process.component, document, has.channels)
            _check_variables(process, process.component, document, has)
    speeds = [plan.scan_speed_m_s for plan in resolved.plans.values()]
    usual_m_s = next((speed for speed in speeds if speed is not None), None)
    for name, plan in resolved.plans.items():
        if what := planned_measurements.too_slow(plan, usual_m_s):
            resolved.warning(f"[{name}] {what}", name, "every", hint="rounds that come too late are left out")


def _corrects_drift(resolved: ResolvedExperiment) -> bool:
    return any(DRIFT in scheduler.declared.publishes for scheduler in resolved.with_role(Role.SCHEDULER))


def _check_channels(process: ResolvedProcess, component: type, document: Document, there: ChannelRoles) -> None:
    for path, channel, of_heights in component_settings.channels(component, process.settings):
        if reason := there.refuses(channel) or (of_heights and there.refuses_as_height(channel)):
            what = f"[{process.name}] {'.'.join(path)}: {reason}"
            hint = f"it has {there.described()}; [microscope.channels] names others"
            document.error(what, process.name, *path, hint=hint)


def _check_variables(
    process: ResolvedProcess, component: type, document: Document, has: MicroscopeCapabilities
) -> None:
    there = has.channels
    needed = getattr(component, "needed_variables", None)
    if needed is None or there.variables is None:
        return
    for roles in needed(process.settings):
        if reason := there.variables.refuses(*roles, read=has.parameters):
            what = f"[{process.name}] needs {' or '.join(roles)} in its curves: {reason}"
            hint = f"they have {', '.join(there.variables.names)}; [microscope.channels] gives further names"
            document.error(what, process.name, hint=hint)


def _cache_section(table: Table, document: Document) -> CacheSettings:
    section = parse(CacheSettings, "cache", dict(table), document)
    if section.mapping is not None:
        _check_cache_mapping(section.mapping, document)
    return section


def _check_cache_mapping(name: str, document: Document) -> None:
    try:
        function = class_loader.load(name)
    except class_loader.Unloadable as error:
        document.error(f"[cache] mapping: {error.what}", "cache", "mapping", hint=error.hint)
        return
    if not callable(function):
        document.error(f"[cache] mapping: {name} is not a function", "cache", "mapping")
        return
    for header in _EXAMPLE_HEADERS:  # a failure at run time would lose packets
        try:
            Envelopes(mapping=function).of(header)
        except AfspmError as error:
            document.error(f"[cache] mapping: {error.what}", "cache", "mapping", hint=error.hint)
            return


def _report_errors_inside(process: ResolvedProcess, component: type, resolved: ResolvedExperiment) -> None:
    # Some settings are wrong already, so the component can't be made properly; its errors count only within
    # tables that were sound, since settings that contradict each other may agree once the others are corrected.
    sound = process.settings.keys() - (process.wrong or ())
    try:
        planned_measurements.plan_of(component, process.settings)
    except AfspmError as error:
        for fault in individual_errors(error):
            inside = _inside(fault)
            if len(inside) > 1 and inside[0] in sound:
                _report(process.name, fault, resolved)
    except Exception:  # made of wrong settings, its constructor may raise anything
        return


def _report_errors_beside(
    process: ResolvedProcess, component: type, wrong: Collection[str], resolved: ResolvedExperiment
) -> None:
    # A constructor raises its first error. Without the setting at fault it raises the next, so that a person need not
    # mend and check again for each. An error that names a setting left out here may come from that: it can wait.
    remaining, left_out = dict(process.settings), {*wrong}
    while left_out & remaining.keys():
        remaining = {key: value for key, value in remaining.items() if key not in left_out}
        try:
            planned_measurements.plan_of(component, remaining)
        except AfspmError as error:
            for fault in individual_errors(error):
                inside = _at_fault(component, remaining, fault)
                named = {*_WORDS.findall(f"{fault.what} {fault.hint}")}
                if len(inside) == 1 and inside[0] in remaining and not named & left_out:
                    _report(process.name, fault, resolved, inside)
                left_out |= {str(key) for key in inside[:1]}
        except Exception:  # without a setting that it needs, a constructor may raise anything
            return


def _at_fault(component: type, given: Table, error: AfspmError) -> tuple[str | int, ...]:
    # the setting that the error names, or without which the constructor does not raise it
    if (inside := _inside(error)) and inside[0] in given:
        return inside
    needed = []
    for name in given:
        others = {key: value for key, value in given.items() if key != name}
        try:
            planned_measurements.plan_of(component, others)
        except AfspmError as another:
            if all(str(fault) != str(error) for fault in individual_errors(another)):
                return (name,)
        except Exception:  # a setting that it needs is left out
            needed.append(name)
        else:
            return (name,)
    return tuple(needed) if len(needed) == 1 else ()


def _report(name: str, error: AfspmError, resolved: ResolvedExperiment, location: tuple[str | int, ...] = ()) -> None:
    inside = _inside(error)
    message = f"{validation_messages.name_of((name, *inside))}{':' if inside else ''} {error.what}"
    resolved.document.error(message, name, *(location or inside), hint=error.hint)


def _inside(error: AfspmError) -> tuple[str | int, ...]:
    # "panel[1].set" is ("panel", 1, "set").
    where = error.where.removeprefix("simulation.").removeprefix("the experiment file, ")
    return tuple(int(index) if index else key for key, index in _STEP.findall(where))


def _resolve_plan(
    process: ResolvedProcess, component: type, resolved: ResolvedExperiment, has: MicroscopeCapabilities | None
) -> None:
    # the component is made once, since its constructor checks best whether settings fit together
    name = process.name
    try:
        plan = planned_measurements.plan_of(component, process.settings)
    except AfspmError as error:
        wrong = set()
        for fault in individual_errors(error):
            inside = _at_fault(component, process.settings, fault)
            _report(name, fault, resolved, inside)
            wrong |= {str(key) for key in inside[:1]}
        _report_errors_beside(process, component, wrong, resolved)
        return
    except Exception as error:  # the constructor may be the user's, and raise anything
        resolved.document.error(f"[{name}] refuses its settings: {type(error).__name__}: {error}", name)
        return
    if plan is None:
        return
    try:
        plan = planned_measurements.by_canonical_name(plan, resolved.limits.bias)
    except AfspmError as error:
        _report(name, error, resolved, ("parameters", names.BIAS_OF_SAMPLE))
        return
    process.declared = replace(
        process.declared, needs_actions=plan.needs_actions, needs_parameters=plan.needs_parameters
    )
    resolved.plans[name] = plan
    for refusal in planned_measurements.refusals(name, plan, resolved.limits):
        what = f"[{name}] plans what its limits refuse: {refusal.reason}"
        resolved.document.error(what, name, *refusal.where, hint=refusal.hint)
    if _corrects_drift(resolved):
        for doubt in plan.drift_doubts:
            resolved.document.warning(f"[{name}] {doubt.what}", name, doubt.where, hint=doubt.hint)
    if has is None:
        return
    wanted: list[tuple[tuple[str, ...], Parameter]] = [((name,), parameter) for parameter in plan.frame()]
    for key, parameters in plan.parameters.items():
        wanted += [((name, key, parameter.name), parameter) for parameter in parameters]
    refused: list[tuple[tuple[str | int, ...], str]] = [(path, has.refuses(parameter)) for path, parameter in wanted]
    if not any(reason for _, reason in refused):
        refused += [((name, *path), has.refuses_frame(region, shape)) for path, region, shape in plan.scans()]
        if not plan.is_listed:  # of a grid outside, one reason is enough
            refused.sort(key=lambda one: not one[1])
            del refused[1:]
    for path, reason in refused:
        if reason:
            resolved.document.error(f"[{name}] plans what its microscope refuses: {reason}", *path)


def _written_role(part: ExperimentPart, resolved: ResolvedExperiment) -> Role:
    # a command has no class to derive from: the key `role` decides, else wiring keys that only one role has
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
    if not isinstance(given, list) or not all(isinstance(entry, str) for entry in given):
        document.error("`messages` is not a list of texts", "messages", hint='messages = ["my.proto"]')
        return ()
    sources = []
    for i, entry in enumerate(given):
        if not entry.endswith(".proto"):
            sources.append(entry)
            if class_loader.find_module(entry, document.folders) is None:
                document.error(f"messages: there is no module {entry!r}", "messages", i, hint="or give a .proto file")
            continue
        file = document.folder_of("messages") / entry
        sources.append(str(file))
        if not file.is_file():
            hint = "it is looked for beside the experiment file"
            document.error(f"messages: there is no file {entry!r}", "messages", i, hint=hint)
    return tuple(sources)


def _problems(table: Table, document: Document) -> dict[str, int]:
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
