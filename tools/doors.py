"""Holds plug-ins to the doors of the core: `python tools/doors.py`, and writes their page for tools/docs.py.

A door is a package whose `__init__` lists what others may use. A plug-in, a distribution in packages/, or a sample of a
package imports doors, its own folder, and the modules of PAST_THE_DOORS, a list that may only get shorter. So do the
tests of plug-ins, whose imports past the doors are counted.
"""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Final, get_origin

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / "src" / "afspm"
PACKAGES = ROOT / "packages"
TESTS = ROOT / "tests" / "plugins"
SAMPLES = (ROOT / "tests" / "support" / "example_maker", ROOT / "tests" / "support" / "example_plugin")
DOORS: Final = {
    "afspm": "components and scripts",
    "afspm.basics": "all: errors, units, quantities as text, clocks, plain data",
    "afspm.model": "all: scans, spectra, regions, states, requests",
    "afspm.driver": "drivers of controllers",
    "afspm.emulation": "emulated controllers",
    "afspm.record": "the record of a night as kept: journal, files, run.json",
    "afspm.night": "a night that is read or goes on: runs, tables, the overview",
    "afspm.drawing": "pictures, charts and timelines",
    "afspm.report": "reports, comparisons and figures of nights",
    "afspm.scheduler": "coordinate frames, approvals, replays",
    "afspm.components": "components: judges of tips, pairs of channels, plans, files and states that last",
    "afspm.client": "pages and scripts: connections, measurements and settings as a script makes them",
    "afspm.cli": "commands",
    "afspm.experiment": "experiment files",
    "afspm.supervisor": "runs that are started, rehearsed or resumed",
    "afspm.storage": "the packet log of a run",
    "afspm.transport": "bridges and replays: sockets of one side of a run, and the events of the other",
    "afspm.testing": "tests of any of these",
}
WHOLE: Final = {"afspm", "afspm.components", "afspm.basics", "afspm.model", "afspm.testing"}
"""Doors for authors outside this tree, or with whole families of data and errors: a name may have one user here."""
MOST_NAMES: Final = 80
OF_ONE_VERSION: Final = {"afspm-agents", "afspm-lab", "afspm-published"}
"""Distributions in packages/ that name the exact version of afspm they are made for, and may import behind doors."""
PAST_THE_DOORS: Final = {
    "afspm.components.tip_verdict": "line_watch web",
    "afspm.model.sessions": "web",
    "afspm.supervisor.run_folder": "replay",
    "afspm.transport.process.signals": "replay",
    "afspm.wire": "drift replay web",
    "afspm.wire.messages": "drift line_watch web",
}
"""Modules behind the doors that plug-ins still import, with these plug-ins."""
NAMES_IN_TESTS: Final = {
    "asylum": 2,
    "bluesky": 3,
    "drift": 35,
    "gxsm": 7,
    "hosts": 3,
    "line_watch": 5,
    "nanonis": 3,
    "panel_table": 1,
    "secop": 11,
    "vendor_bench": 2,
    "web": 16,
}
"""Names that the tests of a plug-in still import past the doors, by the test's folder; these counts may only shrink."""


def main() -> int:
    """Print what is wrong with the doors and their use; return the exit code."""
    wrong = [*_wrong_imports(), *_wrong_tests(), *_wrong_doors()]
    sys.stdout.writelines(f"{line}\n" for line in wrong)
    return int(bool(wrong))


def plug_in_interface() -> str:
    """Return the tables of all doors."""
    lines = []
    for door, of in DOORS.items():
        lines += [f"## `{door}`: {of}", "", "| name | |", "| --- | --- |"]
        lines += [f"| `{name}` | {_about(door, name)} |" for name in sorted(_names(door), key=str.casefold)]
        lines.append("")
    return "\n".join(lines)


def past_the_doors() -> dict[str, set[str]]:
    """Return each module of the core that is no door, with the plug-ins held to the doors that import it."""
    past: dict[str, set[str]] = defaultdict(set)
    for plug_in, module, name in _used():
        if plug_in not in OF_ONE_VERSION and (target := _target(module, name)) not in DOORS:
            past[target].add(plug_in)
    return past


def _wrong_imports() -> Iterator[str]:
    past = past_the_doors()
    for module, plug_ins in sorted(past.items()):
        for plug_in in sorted(plug_ins - set(PAST_THE_DOORS.get(module, "").split())):
            yield f"{plug_in} imports {module}, which is behind a door: see docs/reference/plug-in-interface.md"
    for module, listed in PAST_THE_DOORS.items():
        for plug_in in sorted(set(listed.split()) - past.get(module, set())):
            yield f"{plug_in} no longer imports {module}: strike it from the list in tools/doors.py"


def _wrong_tests() -> Iterator[str]:
    folders = [(file, file.relative_to(TESTS).parts[0].removesuffix(".py")) for file in TESTS.rglob("*.py")]
    held = [folder for folder in PACKAGES.iterdir() if folder.name not in OF_ONE_VERSION]
    folders += [(file, folder.name) for folder in held for file in folder.glob("tests/**/*.py")]
    count = Counter(folder for folder, *imported in _imports(folders) if _target(*imported) not in DOORS)
    for folder in sorted({*count, *NAMES_IN_TESTS}):
        listed = NAMES_IN_TESTS.get(folder, 0)
        if count[folder] > listed:
            yield f"tests of {folder} import {count[folder]} names past the doors, not {listed}: import a door"
        if count[folder] < listed:
            yield f"tests of {folder} import {count[folder]} names past the doors: lower {listed} in tools/doors.py"


def _wrong_doors() -> Iterator[str]:
    users: dict[tuple[str, str], set[str]] = defaultdict(set)
    rooms = [(file, file.relative_to(CORE).parts[0]) for file in CORE.rglob("*.py") if file.parent != CORE]
    for user, module, name in (*_used(), *_imports([room for room in rooms if room[1] != "plugins"])):
        if not f"{module}.".startswith(f"afspm.{user}."):
            users[module, name].add(user)
    for door in DOORS:
        names = _names(door)
        if len(names) > MOST_NAMES:
            yield f"{door} has {len(names)} names, more than {MOST_NAMES}: move what one plug-in alone needs"
        if unlisted := {name for _, name, _ in _homes(door)} ^ set(names):
            yield f"{door}: __all__ and its imports differ in {', '.join(sorted(unlisted))}"
        if differing := {(module, name) for module, name, _ in _homes(door)} ^ set(_loaded(door)):
            names_of = ", ".join(sorted(f"{module}.{name}" for module, name in differing))
            yield f"{door}: its imports and the names that it gives to lazily() differ in {names_of}"
        yield from (f"{door}.{name} has no docstring" for name in names if not _about(door, name))
        if door in WHOLE:
            continue
        for _, name, has_reason in _homes(door):
            if not has_reason and len(users[door, name]) < 2:
                yield f"{door}.{name} has {len(users[door, name])} user: give a reason, beside `if TYPE_CHECKING:`"


def _used() -> Iterator[tuple[str, str, str]]:
    """Yield (plug-in, module of the core, name) for each import of a plug-in."""
    folders = [(file, file.relative_to(CORE).parts[1]) for file in (CORE / "plugins").rglob("*.py")]
    folders += [(file, file.relative_to(PACKAGES).parts[0]) for file in PACKAGES.glob("*/src/**/*.py")]
    folders += [(file, sample.name) for sample in SAMPLES for file in sample.rglob("*.py")]
    yield from _imports(folders)


def _imports(folders: list[tuple[Path, str]]) -> Iterator[tuple[str, str, str]]:
    """Yield (folder, module of the core, name) for each import of these (file, folder)."""
    for file, folder in folders:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and re.match(r"afspm(?!\.plugins)(\.|$)", node.module or ""):
                yield from ((folder, node.module or "", alias.name) for alias in node.names)


def _target(module: str, name: str) -> str:
    """Return the module that an import of `name` from `module` reaches."""
    if module in DOORS and name in _names(module):
        return module
    return f"{module}.{name}" if _file(f"{module}.{name}") else module


def _homes(door: str) -> Iterator[tuple[str, str, bool]]:
    """Yield (module, name, whether a reason is given) for each name that a door imports."""
    file = _file(door)
    assert file is not None
    source = file.read_text(encoding="utf-8")
    lines = source.splitlines()
    for block in ast.parse(source).body:
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING":
            for node in block.body:
                assert isinstance(node, ast.ImportFrom)
                for alias in node.names:
                    yield node.module or "", alias.asname or alias.name, "#" in lines[block.lineno - 1]


def _loaded(door: str) -> Iterator[tuple[str, str]]:
    """Yield (module, name) for each name that a door loads on first use."""
    file = _file(door)
    assert file is not None
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "lazily":
            homes = ast.literal_eval(node.args[1])
            yield from ((module, name) for module, several in homes.items() for name in several.split())
            for home in node.keywords:
                yield ast.literal_eval(home.value).rpartition(".")[0], home.arg or ""


@cache
def _names(door: str) -> list[str]:
    return list(importlib.import_module(door).__all__)


def _file(module: str) -> Path | None:
    path = ROOT / "src" / Path(*module.split("."))
    return next((f for f in (path / "__init__.py", path.with_suffix(".py")) if f.is_file()), None)


def _about(door: str, name: str) -> str:
    thing = getattr(importlib.import_module(door), name)
    if inspect.ismodule(thing) or inspect.isclass(thing) or inspect.isfunction(thing):
        text = (inspect.getdoc(thing) or "").partition("\n")[0]
        if inspect.isclass(thing) and "dataclass" not in text and text.startswith(f"{name}("):
            text = ""  # the signature that Python writes in place of a docstring
        text = text or _of_constant(door, name)  # a type under a name of its own
    else:
        text = _of_constant(door, name) or ("a type" if get_origin(thing) else f"`{_short(thing)}`")
    return text.replace("|", "\\|")


def _of_constant(door: str, name: str) -> str:
    """Return the text under the assignment of a constant or a type in its module, "" if there is none."""
    home = next((module for module, own, _ in _homes(door) if own == name), None)
    file = _file(home) if home else None
    body = ast.parse(file.read_text(encoding="utf-8")).body if file else []
    for node, after in pairwise(body):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            return re.split(r"(?<=\.) ", " ".join(str(text).split()))[0]
    return ""


def _short(thing: object) -> str:
    text = repr(thing)
    if " at 0x" in text:  # an address of this run
        return type(thing).__name__
    return text if len(text) <= 60 else text[:59] + "…"


if __name__ == "__main__":
    sys.exit(main())
