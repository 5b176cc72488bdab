"""The reference of the Python API, made of signatures and docstrings: for tools/docs.py."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterator
from enum import Enum
from functools import cached_property
from itertools import pairwise, zip_longest
from typing import Any

GROUPS = {
    "Join, open, read": ["afspm.connect", "afspm.open_run", "afspm.find_runs", "afspm.read"],
    "Write a component": ["afspm.Component", "afspm.Memory"],
    "Use the microscope": [
        "afspm.Scope",
        "afspm.Events",
        "afspm.PublishedEvent",
        "afspm.client.sweeping.SweepPoint",
    ],
    "Requests and measurements": [
        "afspm.Region",
        "afspm.Scan",
        "afspm.ScanSet",
        "afspm.Spectrum",
        "afspm.driver.FileContent",
    ],
    "After the night": [
        "afspm.Run",
        "afspm.night.tables.Table",
        *(f"afspm.night.measured_tables.{name}" for name in ("KeyedTable", "SpectrumTable")),
        *(f"afspm.night.tables.{name}" for name in ("ScanRow", "SpectrumRow", "NoteRow")),
    ],
    "Surveys": [
        *(f"afspm.components.surveying.{name}" for name in ("find_particles", "nearest", "lowest_beside", "Target")),
        *(f"afspm.components.surveying.{name}" for name in ("SurveyRecord", "Visit", "Outcome")),
    ],
    "State": [
        *(f"afspm.{name}" for name in ("ScopeState", "ControlMode", "Problem")),
        *(f"afspm.model.{name}" for name in ("ControlState", "ScanParameters", "Feedback", "ProbePosition")),
        "afspm.model.ProblemNames",
    ],
    "Units": [f"afspm.basics.units.{name}" for name in ("si", "convert", "parse_quantity", "same_kind")],
    "Errors": [
        *(f"afspm.basics.errors.{name}" for name in ("AfspmError", "Refused", "NoResponse", "MeasurementFailed")),
        *(f"afspm.basics.errors.{name}" for name in ("ControlLost", "ExperimentEnded", "InvalidValue")),
        *(f"afspm.basics.errors.{name}" for name in ("NoSuchItem", "UnitError", "FileError", "ConfigError")),
    ],
}
"""What users write with, by its full name."""
BY_THE_LIBRARY = frozenset({"run_process", "give_back_inherited"})
"""Public methods that afspm calls itself."""
WIDTH = 100
# A name (or several) at exactly four spaces: a sentence or a continuation line with a colon in it is no entry
_ENTRY = re.compile(r"    (\*{0,2}[\w.]+(?:, \*{0,2}[\w.]+)*): (.*)")


def python_api() -> str:
    """Return the page: each group with what is in it."""
    return "\n".join(
        part for title, names in GROUPS.items() for part in (f"## {title}\n", *(_described(name) for name in names))
    )


def _described(path: str) -> str:
    module, _, name = path.rpartition(".")
    found = getattr(importlib.import_module(module), name)
    title = f"### {name}\n\n`{path}`\n"
    if not inspect.isclass(found):
        return "\n".join([title, _signature(name, found), _markdown(found)])
    if issubclass(found, Enum):
        return "\n".join([title, _markdown(found), *(f"- `{one.name}` = {one.value}" for one in found), ""])
    made = [_signature(name, found)] if dataclasses.is_dataclass(found) else []
    attributes = [f"- `{declared}`: {text}\n" for declared, text in _attributes(found)]
    members = list(_members(found))
    links = [" · ".join(f"[{one}](#{name.lower()}{one})" for one in members) + "\n"] if len(members) > 3 else []
    text = _markdown(found, skipped="" if made else "Args:")
    if bases := _on_page(found):
        text += f"\nAlso all of [{bases[0].__name__}](#{bases[0].__name__.lower()}).\n"
    return "\n".join([title, *made, text, *attributes, *links, *(_member(name, one, found) for one in members)])


def _members(class_: type) -> Iterator[str]:
    """Yield the public methods and properties that afspm defines, of its bases last; not of those on the page."""
    ours = [base for base in class_.__mro__ if base.__module__.startswith("afspm")]
    bases = [base for base in ours if base is class_ or base not in _on_page(class_)]
    names = dict.fromkeys(name for base in bases for name, value in vars(base).items() if _is_member(value))
    yield from (name for name in names if not name.startswith("_") and name not in BY_THE_LIBRARY)


def _on_page(class_: type) -> list[type]:
    """Return the bases of a class that are described themselves."""
    names = {path.rpartition(".")[2] for paths in GROUPS.values() for path in paths}
    return [base for base in class_.__mro__[1:] if base.__module__.startswith("afspm") and base.__name__ in names]


def _is_member(value: Any) -> bool:
    return isinstance(value, (property, cached_property, classmethod, staticmethod)) or inspect.isfunction(value)


def _member(owner: str, name: str, class_: type) -> str:
    found, value = inspect.getattr_static(class_, name), getattr(class_, name)
    getter = found.fget if isinstance(found, property) else getattr(found, "func", None)
    if getter is None:
        return f"#### {owner}.{name}\n\n{_signature(name, value)}\n{_markdown(value)}"
    declared = f"{name}: {inspect.signature(getter).return_annotation}"
    return f"#### {owner}.{name}\n\n```py\n{declared}\n```\n\n{_markdown(getter)}"


class _AsWritten(str):
    """An annotation, shown without quotes."""

    def __repr__(self) -> str:
        return str(self)


def _signature(name: str, found: Any) -> str:
    """Return a signature as a block of code, a parameter to a line where it is long."""
    signature = inspect.signature(found)
    parameters = [
        one.replace(annotation=_as_written(one.annotation))
        for one in signature.parameters.values()
        if one.name != "self"
    ]
    returns = "" if inspect.isclass(found) else f" -> {signature.return_annotation}"
    shown = f"{name}{inspect.Signature(parameters)}{returns}"
    if len(shown) > WIDTH:
        first_named = next((k for k, one in enumerate(parameters) if one.kind is one.KEYWORD_ONLY), len(parameters))
        told = [*map(str, parameters[:first_named]), *["*"][: len(parameters) - first_named]]
        told += map(str, parameters[first_named:])
        shown = "\n".join([f"{name}(", *(f"    {one}," for one in told), f"){returns}"])
    shown = re.sub(r"<(\w+\.\w+): [^>]*>", r"\1", shown).replace("<factory>", "…")
    return f"```py\n{shown}\n```\n"


def _as_written(annotation: Any) -> Any:
    return _AsWritten(annotation) if isinstance(annotation, str) else annotation


def _attributes(class_: type) -> Iterator[tuple[str, str]]:
    """Yield the declarations of a class that have a text below them, and that."""
    (definition,) = ast.parse(inspect.getsource(class_)).body
    assert isinstance(definition, ast.ClassDef)
    for one, below in pairwise(definition.body):
        if isinstance(one, ast.AnnAssign) and isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            yield ast.unparse(one), " ".join(str(below.value.value).split())


def _markdown(found: Any, skipped: str = "") -> str:
    """Return a docstring as Markdown: what it lists becomes a list; the section `skipped` is left out."""
    lines = (inspect.getdoc(found) or "").splitlines()
    made: list[str] = []
    section = ""
    for line, below in zip_longest(lines, lines[1:], fillvalue=""):
        entry = _ENTRY.fullmatch(line) if section else None
        if line and not line.startswith(" "):
            is_section = line.endswith(":") and not line.endswith("::") and below.startswith("    ")
            section = line if is_section else ""
            made += [f"**{line}**", ""] if is_section else [re.sub("::$", ":", line)]
        elif entry:
            names = ", ".join(f"`{name}`" for name in re.split(r",\s*", entry[1]))
            made.append(f"- {names}: {entry[2]}")
        else:
            made.append(f"{'  ' * line.startswith(' ' * 8)}{line.strip()}" if section else line)
    text = "\n".join(made).strip()
    if skipped:
        text = re.sub(rf"\*\*{skipped}\*\*.*?(?=\n\*\*|\Z)", "", text, flags=re.DOTALL).strip()
    return f"{text}\n"
