"""Writes the parts of the documentation that follow from the code: `python tools/docs.py` (or `--check`).

In a page, what stands between `<!-- from the code: NAME -->` and `<!-- end -->` is made here.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import sys
import tomllib
import typing
from collections.abc import Callable, Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import claims
import doors
import python_api
import quality
import state_diagram

from afspm import Component, wire
from afspm.basics import entry_points
from afspm.basics.units import Unit
from afspm.model import ChannelRoles, Role
from afspm.model.channels import ROLES
from afspm.scheduler.control import arbitration
from afspm.scheduler.control.arbitration import RoleTable
from afspm.scheduler.publishing.envelopes import CacheRule, CacheSettings
from afspm.scheduler.safety.limits import Limit
from afspm.scheduler.settings import ControlSettings
from afspm.simulation.drift import Relaxation
from afspm.simulation.faults import Fault
from afspm.simulation.feedback import MODES
from afspm.simulation.simulator import FAULT_KINDS, Simulator
from afspm.simulation.simulator.controller import PanelEvent
from afspm.simulation.surfaces import KINDS
from afspm.simulation.world import WorldSettings
from afspm.testing.commissioning.report import TRIED_ON, InstrumentReport
from afspm.testing.commissioning.steps import OPERATIONS
from afspm.translator.judge import WITNESSES

ROOT = Path(__file__).resolve().parents[1]
SET_BY_AFSPM = ("unit", "source")  # of a limit: no keys of the file
BLOCK = re.compile(r"(<!-- from the code: ([\w-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def control_diagram() -> str:
    return f"```mermaid\n{state_diagram.mermaid()}```\n"


def transition_table() -> str:
    lines = ["| a component … | when | it gets | and | because |", "| --- | --- | --- | --- | --- |"]
    for event, row in [(event, row) for event, rows in arbitration.TABLE.items() for row in rows]:
        answer = "the translator's answer" if arbitration.ControlChange.FORWARD in row.do else "—"
        if row.response is not None:
            answer = f"`REP_{row.response.name}`"
        done = ", ".join(_done(do) for do in row.do if do is not arbitration.ControlChange.FORWARD) or "nothing changes"
        lines.append(f"| {event.value} | {row.when.text} | {answer} | {done} | {row.why} |")
    return "\n".join(lines) + "\n"


def instruments() -> str:
    """The matrix: how far each operation of each maker's controller has been tried, from the reports."""
    reports = [
        InstrumentReport.read(file) for folder in _makers().values() for file in sorted(folder.glob("reports/*.toml"))
    ]
    rows = sorted({(report.maker, report.release) for report in reports})
    lines = ["| maker | release | " + " | ".join(OPERATIONS) + " |", "| --- " * (len(OPERATIONS) + 2) + "|"]
    for row in rows:
        of_row = [report for report in reports if (report.maker, report.release) == row]
        cells = [_tried(of_row, operation) for operation in OPERATIONS]
        lines.append("| " + " | ".join([*row, *cells]) + " |")
    told = [f"- {one.maker}, {one.release}, *{one.tried_on}*: {one.evidence}. {one.note}".rstrip() for one in reports]
    return "\n".join([*lines, "", *told]) + "\n"


def controllers() -> str:
    """The table of drivers: the maker, its program, the class, and how the controller is set up and emulated."""
    lines = ["| maker | program | class | set it up | emulated |", "| --- | --- | --- | --- | --- |"]
    for driver, folder in _makers().items():
        class_, emulated = entry_points.load(entry_points.DRIVERS, driver), f"{driver}Emulator"
        readme = f"[README](../../{(folder / 'README.md').relative_to(ROOT).as_posix()})"
        is_emulated = emulated in entry_points.names(entry_points.EMULATORS)
        shown = f"`{emulated}`, [emulated.toml](../../{(folder / 'emulated.toml').relative_to(ROOT).as_posix()})"
        lines.append(f"| {class_.maker} | {class_.software} | `{driver}` | {readme} | {shown if is_emulated else ''} |")
    return "\n".join(lines) + "\n"


def channels() -> str:
    """The table of roles: each maker's own names of its channels."""
    drivers = {driver: entry_points.load(entry_points.DRIVERS, driver) for driver in _makers()}
    every = {name: one.declared_channels({}) for name, one in drivers.items() if not one.simulated}
    simulated = (Simulator.declared_channels({"feedback": {"mode": mode}}) for mode in MODES)
    every["Simulator"] = reduce(lambda some, more: ChannelRoles({**some.names, **more.names}), simulated)
    lines = ["| role | " + " | ".join(f"`{driver}`" for driver in every) + " |", "| --- " * (len(every) + 1) + "|"]
    for role in (one for one in ROLES if any(one in of.names for of in every.values())):
        cells = [", ".join(of.names.get(role, ())) for of in every.values()]
        lines.append("| " + " | ".join([role, *cells]) + " |")
    return "\n".join(lines) + "\n"


def witnesses() -> str:
    """The table of what proves a result: by maker each witness, or the reason why the controller never shows it."""
    drivers = [entry_points.load(entry_points.DRIVERS, name) for name in [*quality.drivers(), "Simulator"]]
    sys.path.append(str(ROOT / "packages/afspm-nion/src"))
    drivers.append(importlib.import_module("afspm_nion").Nion)
    if silent := [one.__name__ for one in drivers if one.never_shows is None]:
        sys.exit(f"{', '.join(silent)}: has no `never_shows`; name each of WITNESSES that the controller never shows")
    lacking = [one.without_witness({}) for one in drivers]
    rows = [(witness, *(one.get(witness, "yes") for one in lacking)) for witness in WITNESSES]
    return _markdown(("witness", *(f"`{one.__name__}`" for one in drivers)), rows)


def matrix() -> str:
    """The table of what runs on what, from the record of `make test-matrix`."""
    jobs = tomllib.loads((ROOT / "tests/system/matrix/matrix.toml").read_text(encoding="utf-8"))
    rows = sorted((component, on) for job in jobs.values() for component, on in job.items())
    instruments = list(rows[0][1])
    lines = ["| component | " + " | ".join(instruments) + " |", "| --- " * (len(instruments) + 1) + "|"]
    for component, on in rows:
        name, _, of = component.partition(" ")
        # what is wrong stands out
        cells = [re.sub("^(wrong|measures nothing)", r"**\1**", on[instrument]) for instrument in instruments]
        lines.append("| " + " | ".join([f"`{name}` {of}".rstrip(), *cells]) + " |")
    return "\n".join(lines) + "\n"


def _makers() -> dict[str, Path]:
    """The folders of the drivers with a README, by the name of the driver."""
    names = entry_points.names(entry_points.DRIVERS)
    folders = ((name, entry_points.folder(entry_points.DRIVERS, name)) for name in names)
    return {name: folder for name, folder in folders if folder is not None and (folder / "README.md").exists()}


def _tried(reports: list[InstrumentReport], operation: str) -> str:
    """Return the best level at which an operation was tried: a mismatch at a level hides what passed at lower ones."""
    for level in TRIED_ON:
        outcomes = [one.operations.get(operation, "") for one in reports if one.tried_on == level]
        for outcome, shown in (("mismatch", f"**wrong** ({level})"), ("passed", level), ("not supported", "none")):
            if outcome in outcomes:
                return shown
    return ""


def _done(do: arbitration.ControlChange) -> str:
    return {
        arbitration.ControlChange.GRANT: "it is in control",
        arbitration.ControlChange.TAKE: "no component is in control",
        arbitration.ControlChange.FLAG: "the problem is flagged",
        arbitration.ControlChange.UNFLAG: "the flag is removed",
        arbitration.ControlChange.SET_MODE: "the mode is set",
        arbitration.ControlChange.PAUSE: "the mode is MANUAL",
        arbitration.ControlChange.END: "the experiment ends",
    }[do]


def component_pages() -> str:
    """Each component of the one distribution: what it does, and its settings."""
    # packages have pages of their own, and need not be installed
    every = entry_points.names(entry_points.COMPONENTS)
    own = [name for name in every if str(entry_points.class_path(name)).startswith("afspm.")]
    found = {name: entry_points.load(entry_points.COMPONENTS, name) for name in own}
    return "\n".join(_class_page(name, class_) for name, class_ in found.items() if issubclass(class_, Component))


def simulator_page() -> str:
    """The simulated microscope: its settings, and those of each table in them."""
    parts = [_class_page("Settings", Simulator)]
    parts += [_table_page(f'surface = "{kind}"', cls) for kind, cls in KINDS.items()]
    hints = typing.get_type_hints(WorldSettings)
    parts += [_table_page(name, hints[name]) for name in WorldSettings.__dataclass_fields__]
    parts += [_table_page("relaxing, in drift", Relaxation)]
    kinds = [
        "| kind | effect |",
        "| --- | --- |",
        *(f"| `{kind}` | {does} |" for kind, does in FAULT_KINDS.items()),
        "",
    ]
    parts += [_table_page("each of faults", Fault), *kinds, _table_page("each of panel", PanelEvent)]
    return "\n".join(parts)


def section(cls: type) -> str:
    """A table of the experiment file that a dataclass describes: keys, defaults if there are any, and meanings."""
    _, meanings = _docstring(cls, "Attributes")
    hints, key_of = typing.get_type_hints(cls, include_extras=True), vars(cls)["__pydantic_config__"]["alias_generator"]
    rows = []
    for one in dataclasses.fields(cls):
        default = one.default if one.default_factory is dataclasses.MISSING else None
        shown = "none" if default in (None, ()) else _value(default, hints[one.name], ())
        if key_of(one.name) not in SET_BY_AFSPM:
            rows.append((f"`{key_of(one.name)}`", shown, meanings[one.name].rstrip(".")))
    if all(shown == "none" for _, shown, _ in rows):
        rows = [(key, meaning) for key, _, meaning in rows]
    heads = ("key", "default", "meaning") if len(rows[0]) == 3 else ("key", "meaning")
    return _markdown(heads, rows)


def messages() -> str:
    """Each message that travels in a packet, as it is declared."""
    rows = [
        (
            f"`{one.name}`",
            PUBLISHERS[one.source],
            _kept(one),
            f"`{one.handler}`",
            f"`{one.event}`" if one.event else "—",
        )
        for one in wire.declared()
        if one.source is not None
    ]
    return _markdown(("message", "published by", "kept for late joiners", "handler", "event of the gateway"), rows)


PUBLISHERS = {Role.TRANSLATOR: "translator", Role.SCHEDULER: "scheduler", Role.COMPONENT: "components"}


def _kept(message: wire.MessageDeclaration) -> str:
    count = {0: "none", 1: "the newest"}.get(message.history, f"the newest {message.history}")
    return f"{count} of each envelope" if message.named else count


def _markdown(heads: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heads, ("---",) * len(heads), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _table_page(title: str, cls: type) -> str:
    """A table of settings that is a dataclass in the code."""
    told = [_docstring(one, "Attributes") for one in cls.__mro__ if dataclasses.is_dataclass(one)]
    text, meanings = told[0][0], {name: meaning for _, meanings in reversed(told) for name, meaning in meanings.items()}
    lines = [f"### {title}", "", text, "", "| key | default | meaning |", "| --- | --- | --- |"]
    within = []
    for one in dataclasses.fields(cls):
        default = one.default if one.default_factory is dataclasses.MISSING else one.default_factory()
        told = "(needed)" if default is dataclasses.MISSING else _plain(default)
        if dataclasses.is_dataclass(default):
            told, within = "(below)", [*within, _table_page(f"{one.name}, in {title}", type(default))]
        lines.append(f"| `{one.name}` | {told} | {meanings.get(one.name, '')} |")
    return "\n".join([*lines, "", *within])


def _plain(value: Any) -> str:
    """A default as it would be written in a file."""
    if isinstance(value, bool) or value is None:
        return _value(value, Any, ())
    if isinstance(value, (list, tuple)):
        return "`[" + ", ".join(_plain(one).strip("`") for one in value) + "]`"
    return f"`{value:g}`" if isinstance(value, (float, int)) else f'`"{value}"`'


def _class_page(name: str, cls: type) -> str:
    text, _ = _docstring(cls)
    lines = [f"## {name}", "", text, ""]
    said = {"solves": "Solves", "flags": "Flags", "publishes": "Publishes", "requires": "Needs"}
    for attribute, says in said.items():
        if told := getattr(cls, attribute, ()):
            lines += [f"{says}: {', '.join(f'`{one}`' for one in told)}.", ""]
    settings = list(_settings(cls))
    if settings:
        lines += ["| setting | value | default | meaning |", "| --- | --- | --- | --- |"]
        for parameter, hint, meanings in settings:
            needed = parameter.default is parameter.empty
            default = "(needed)" if needed else _value(parameter.default, hint, ())
            meaning = meanings.get(parameter.name, "")
            lines.append(f"| `{parameter.name}` | {_kind(hint, ())} | {default} | {meaning} |")
        lines.append("")
    return "\n".join(lines)


def _settings(cls: type) -> Iterator[tuple[inspect.Parameter, Any, dict[str, str]]]:
    """Parameters of the constructor, with their types and meanings; where it hands **keywords on, those of its base."""
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        init, (_, meanings) = vars(base)["__init__"], _docstring(base)
        hints = typing.get_type_hints(init, include_extras=True)
        parameters = list(inspect.signature(init).parameters.values())[1:]
        for parameter in parameters:
            if parameter.kind is not parameter.VAR_KEYWORD:
                yield parameter, hints.get(parameter.name, Any), meanings
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return


def _docstring(cls: type, list_of: str = "Args") -> tuple[str, dict[str, str]]:
    """The docstring without its list of settings, and what that says of each."""
    text, _, listed = (inspect.getdoc(cls) or "").partition(f"\n{list_of}:\n")
    listed = listed.partition("\n\n")[0]  # and not what it raises
    meanings = {}
    for entry in re.split(r"\n(?=    \w)", f"\n{listed}"):
        names, _, meaning = entry.strip().partition(":")
        meanings.update(dict.fromkeys(re.split(r",\s*", names), " ".join(meaning.split())))
    return text.strip(), meanings


_UNITS = {"m": "length", "s": "duration", "rad": "angle", "V": "voltage", "A": "current", "m/s": "speed"}


def _kind(hint: Any, metadata: Any) -> str:
    unit = _unit(hint, metadata)
    if unit:
        return _UNITS.get(unit, f"quantity in {unit}")
    args = [arg for arg in typing.get_args(hint) if arg is not type(None)]
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return _kind(args[0], args[1:])
    if origin is typing.Literal:
        return ", ".join(f'"{arg}"' for arg in args)
    if origin in (tuple, list) or getattr(origin, "__name__", "") in ("Sequence", "Iterable"):
        inner = [_kind(arg, ()) for arg in args if arg is not ...]
        return f"list of {inner[0]}" if inner and len(set(inner)) == 1 else f"[{', '.join(inner)}]"
    if origin is dict or getattr(origin, "__name__", "") == "Mapping":
        return "table"
    if args:
        return " or ".join(dict.fromkeys(_kind(arg, ()) for arg in args))
    plain = {float: "number", int: "whole number", str: "text", bool: "true or false", Path: "path"}
    return plain.get(hint, getattr(hint, "__name__", str(hint)))


def _unit(hint: Any, metadata: Any) -> str:
    for item in metadata:
        if isinstance(item, Unit):
            return item.si
        if found := _unit(item, ()):
            return found
    if typing.get_origin(hint) is typing.Annotated:
        return _unit(typing.get_args(hint)[0], hint.__metadata__)
    return ""


def _value(default: Any, hint: Any, metadata: Any) -> str:
    if default is None:
        return "—"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    if isinstance(default, (list, tuple)):
        return f"`{list(default)}`".replace("'", '"')
    if unit := _unit(hint, metadata):
        return f"`{default:g} {unit}`"
    return f"`{default!r}`".replace("'", '"')


def example_maker() -> str:
    """The files of the sample package of a maker, as the tests install them."""
    package = ROOT / "tests" / "support" / "example_maker"
    shown = [
        ("pyproject.toml", "ini"),
        ("example_maker/parameters.toml", "ini"),
        ("example_maker/driver.py", "py"),
        ("example_maker/emulator.py", "py"),
        ("example_maker/files.py", "py"),
        ("example_maker/emulated.toml", "ini"),
    ]
    parts = (f"`{name}`:\n\n```{kind}\n{(package / name).read_text(encoding='utf-8')}```\n" for name, kind in shown)
    return "\n" + "\n".join(parts)


PARTS: dict[str, Callable[[], str]] = {
    "state-diagram": control_diagram,
    "transition-table": transition_table,
    "instruments": instruments,
    "controllers": controllers,
    "channels": channels,
    "witnesses": witnesses,
    "matrix": matrix,
    "quality": quality.scale_tables,
    "claim-counts": claims.counts,
    "claims": claims.table,
    "quality-rules": quality.rules_table,
    "components": component_pages,
    "simulator": simulator_page,
    "python-api": python_api.python_api,
    "plug-in-interface": doors.plug_in_interface,
    "control": lambda: section(ControlSettings),
    "roles": lambda: section(RoleTable),
    "limit": lambda: section(Limit),
    "cache": lambda: section(CacheSettings),
    "cache-rule": lambda: section(CacheRule),
    "messages": messages,
    "example-maker": example_maker,
}


def made(text: str) -> str:
    """A page with its parts made anew."""
    return BLOCK.sub(lambda block: block[1] + PARTS[block[2]]() + block[3], text)


def main() -> None:
    stale = []
    for page in sorted((ROOT / "docs").rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (new := made(text)) != text:
            stale.append(str(page.relative_to(ROOT)))
            if "--check" not in sys.argv:
                page.write_text(new, encoding="utf-8")
    sys.stdout.write("".join(f"{page}\n" for page in stale))
    sys.exit(bool(stale) and "--check" in sys.argv)


if __name__ == "__main__":
    main()
