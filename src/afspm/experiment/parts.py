"""The top level of the file, sorted into variables, sections, intermediary tables and components."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from afspm.experiment.document import Document
from afspm.experiment.findings import SourceLocation, closest, nearest
from afspm.experiment.toml_lines import Path, Settings, Table
from afspm.experiment.wiring_classes import WIRE_KEYS, wire_of

KNOWN_VARIABLES: Final = frozenset({"name", "messages"})
_INCLUDES = "no file includes another: lay files over each other, as in `afspm run first.toml second.toml`"
SECTIONS: Final = (
    "clock", "control", "limits", "problems", "cache", "security", "restart", "record", "metadata", "notify",
    "conditions",
)  # fmt: skip

# Keys of a component's table that are afspm's; all others are settings of its class or command.
OWN_KEYS: Final = frozenset(
    {"component", "class", "command", "envelopes", "listens_to", "after", "role", "heartbeats", *WIRE_KEYS}
)
SIMULATED = "simulated"
"""Marks a simulated microscope: an attribute of its class, or a key in the table of a command."""
EMULATED = "emulated"
"""Class attribute that marks an emulated controller, to which the translator connects."""
# a command declares in its table what a class declares by attributes
DECLARED_KEYS: Final = ("solves", "flags", "publishes", "listens", "needs_actions", "needs_parameters")


@dataclass(frozen=True)
class ExperimentPart:
    """One process of the experiment file, with references replaced.

    Attributes:
        class_path: the class as written, or converted from another form of file; empty for a command.
        command: program and arguments; empty for a Python class.
        settings: arguments of the constructor, still with units.
        own: the table's keys that belong to afspm (wiring, envelopes, role …).
        implied: whether afspm adds the process to every experiment; it then runs on the scheduler's computer.
    """

    name: str
    class_path: str
    command: tuple[str, ...]
    settings: Table
    own: Table
    place: SourceLocation
    implied: bool = False


@dataclass
class ExperimentParts:
    """The tables of an experiment file, sorted by kind, with references replaced."""

    variables: Settings = field(default_factory=dict)
    sections: dict[str, Settings] = field(default_factory=dict)
    intermediaries: dict[str, Settings] = field(default_factory=dict)
    components: list[ExperimentPart] = field(default_factory=list)
    became: dict[Path, str] = field(default_factory=dict)
    """Equivalent of each line of a file of another form (`forms`)."""
    instead: dict[str, Settings] = field(default_factory=dict)
    """Tables of components without equivalent, by name, unchanged."""
    unused: list[str] = field(default_factory=list)
    """Names of intermediaries without effect."""

    def free_name(self, wanted: str) -> str:
        """Return a name that is not in the file: `wanted`, with a number if that name is taken."""
        taken = {part.name.casefold() for part in self.components}
        taken |= {name.casefold() for name in (*self.variables, *self.intermediaries)}
        names = itertools.chain([wanted], (f"{wanted}{number}" for number in itertools.count(2)))
        return next(name for name in names if name not in taken)


class Converter(Protocol):
    """A converter of components from another form of files."""

    def convert(self, tables: dict[str, Settings], parts: ExperimentParts, document: Document) -> dict[str, Settings]:
        """Return the components in afspm's form, by name; components already in this form are returned unchanged.

        Components that afspm does not run are left out.

        Args:
            tables: components with their references replaced.
            parts: the rest of the file. Intermediaries and sections are converted in place. Equivalents of lines are
                added to `parts.became`, and tables without equivalent to `parts.instead`.
        """


def sort(document: Document, converters: Iterable[Converter] = ()) -> ExperimentParts:
    """Sort the tables of a file, and expand references; report tables that can't be part of an experiment."""
    parts = ExperimentParts()
    raw_components: dict[str, Settings] = {}
    for key, value in document.data.items():
        if not isinstance(value, dict):
            if key in SECTIONS:  # as a variable, it would be without effect: limits that hold nothing back
                document.error(
                    f"{key} is a section, not a value or a list", key, hint=f"once, in single brackets: [{key}]"
                )
            parts.variables[key] = value
        elif _is_component(key, value, document):
            raw_components[key] = value
        elif key in SECTIONS and "class" not in value:
            parts.sections[key] = value
        else:
            parts.intermediaries[key] = value
    # a component that is switched off can still be named, as in `only` of a limit
    values = {name: table for name, table in parts.intermediaries.items() if "component" not in table}
    references = VariableReferences(document, {**parts.variables, **values})
    parts.variables = {k: references.expand(v, (k,)) for k, v in parts.variables.items()}
    parts.sections = {k: references.expand(v, (k,)) for k, v in parts.sections.items()}
    parts.intermediaries = {k: references.expand(v, (k,)) for k, v in parts.intermediaries.items()}
    tables = {name: references.expand(table, (name,)) for name, table in raw_components.items()}
    for converter in converters:
        tables = converter.convert(tables, parts, document)
    for name, table in tables.items():
        if (part := _component(name, table, document)) is not None:
            parts.components.append(part)
    _report_unused(parts, references.used, document)
    return parts


def _is_component(name: str, table: Settings, document: Document) -> bool:
    marked = table.get("component", False)
    if not isinstance(marked, bool):
        document.error(f"`component` of [{name}] is {marked!r}, not true or false", name, "component")
    return marked is True


def _component(name: str, table: Settings, document: Document) -> ExperimentPart | None:
    class_path, command = table.get("class", ""), table.get("command", ())
    if not isinstance(class_path, str):
        document.error(f"`class` of [{name}] is not text", name, "class", hint='class = "module.Name"')
        return None
    if isinstance(command, str):
        command = [command]
    if not isinstance(command, list | tuple) or not all(isinstance(word, str) for word in command):
        document.error(
            f"`command` of [{name}] is not a list of texts", name, "command", hint='command = ["program", …]'
        )
        return None
    if bool(class_path) == bool(command):
        both = "both `class` and `command`" if class_path else "neither `class` nor `command`"
        near = "" if class_path else _misspelt(table, ("class", "command"))
        document.error(f"component [{name}] has {both}", name, hint=near or "one of them says what to run")
        return None
    own_keys = OWN_KEYS if class_path else OWN_KEYS | {SIMULATED, *DECLARED_KEYS}
    return ExperimentPart(
        name=name,
        class_path=class_path,
        command=tuple(command),
        settings={k: v for k, v in table.items() if k not in own_keys},
        own={k: v for k, v in table.items() if k in own_keys},
        place=document.place(name),
    )


def _misspelt(table: Table, wanted: tuple[str, ...]) -> str:
    for key in table:
        near = closest(key, wanted, 0.7)
        if near:
            return f"did you mean {near!r} by {key!r}?"
    return ""


def _report_unused(parts: ExperimentParts, used: set[str], document: Document) -> None:
    components = [part.name for part in parts.components]
    # a file of another form may have values of its own program
    unused = parts.variables.keys() - used - KNOWN_VARIABLES
    for name in () if parts.became else sorted(unused):
        meant = closest(name, sorted({*SECTIONS, *(key for part in parts.components for key in part.settings)}))
        hint = _INCLUDES if name == "include" else f"did you mean {meant!r}, in a table?" if meant else ""
        document.warning(f"nothing uses the variable {name!r}", name, hint=hint)
    for name, table in parts.intermediaries.items():
        if name in used:
            continue
        section = closest(name, SECTIONS, 0.75)
        if section and "class" not in table:
            document.error(f"there is no section [{name}]", name, hint=f"did you mean [{section}]?")
        elif within := [key for key, value in table.items() if isinstance(value, dict) and value.get("component")]:
            whole = f"{name}.{within[0]}"
            hint = f'a name with a dot is written in quotes: ["{whole}"]'
            document.error(f"[{whole}] is within a table [{name}], and no component", name, hint=hint)
        elif "component" in table:
            continue  # switched off: component = false
        elif "class" in table or "command" in table:
            parts.unused.append(name)
            hint = "does it lack `component = true`?" if wire_of(table) is None else ""
            document.warning(f"nothing refers to [{name}]", name, hint=hint)
        elif meant := closest(name, components, 0.8):  # settings that would silently not be in force
            what = f"[{name}] is neither a section nor a component"
            document.error(what, name, hint=f"did you mean [{meant}]? a component of its own has `component = true`")
        else:
            parts.unused.append(name)
            hint = nearest(name, (*SECTIONS, *components))
            document.warning(f"[{name}] is neither a section nor a component", name, hint=hint)


class VariableReferences:
    """A replacer of references: a text that equals a top-level key stands for that key's value.

    Only whole texts count, and only keys of variables and intermediary tables. Names of components and sections are not
    replaced, so that roles and limits can name a component.

    Attributes:
        used: keys that were replaced.
    """

    def __init__(self, document: Document, variables: Table) -> None:
        self._document = document
        self._variables = variables
        self.used: set[str] = set()

    def expand(self, value: object, path: Path) -> Any:
        """Return `value`, set at `path`, with all its references replaced, also within replacements."""
        return self._expand(value, path, ())

    def _expand(self, value: object, path: Path, through: tuple[str, ...]) -> object:
        if isinstance(value, dict):
            return {key: self._expand(item, (*path, key), through) for key, item in value.items()}
        if isinstance(value, list):
            return [self._expand(item, (*path, i), through) for i, item in enumerate(value)]
        if not isinstance(value, str) or value not in self._variables:
            return value
        if value in through:
            self._report_cycle((*through[through.index(value) :], value))
            return value
        self.used.add(value)
        return self._expand(self._variables[value], (value,), (*through, value))

    def _report_cycle(self, around: tuple[str, ...]) -> None:
        # a cycle is found from each of its keys: begin it at its smallest name, so that it is reported once
        ring = around[:-1]
        start = ring.index(min(ring))
        ring = ring[start:] + ring[:start]
        what = " -> ".join((*ring, ring[0]))
        self._document.error(f"references form a cycle: {what}", ring[0])
