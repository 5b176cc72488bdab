"""Entry points, through which installed packages extend afspm.

afspm declares its own drivers, emulators, components, readers, … in its `pyproject.toml`, as any other package does.
One line declares one class::

    [project.entry-points."afspm.components"]
    Ridges = "my_lab.ridges:Ridges"

| comes in | the metadata of all installed packages, read once per process, since reading takes milliseconds |
| goes out | names, paths of classes, loaded objects, and for `afspm doctor` an inventory |
| always holds | nothing is imported until its name is used; a name declared for different objects is refused |
| | a package that can't be read or imported costs its own names alone |
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from afspm.basics.errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import Distribution, EntryPoint

DRIVERS = "afspm.drivers"  # class = "Name" of a translator
EMULATORS = "afspm.emulators"  # class = "Name" of an emulated controller; `afspm emulate NAME`
SCHEDULERS = "afspm.schedulers"  # class = "Name" of a scheduler
COMPONENTS = "afspm.components"  # class = "Name" of a component
READERS = "afspm.readers"  # by the suffix of a file, without its dot: (path, zone) -> FileContent
EXPORTERS = "afspm.exporters"  # afspm export --to NAME: a module, see afspm.report.export
ESTIMATORS = "afspm.estimators"  # of drift, by name
TRACKERS = "afspm.trackers"  # of drift, by name
FIGURES = "afspm.figures"  # of the report: (run, title, again) yields names and figures of matplotlib
DISPLAYS = "afspm.displays"  # of scans and spectra: what their `plot`, `to_sidpy` and notebook pictures call
FUNCTIONS = "afspm.functions"  # of `afspm` itself, for scripts and notebooks: afspm.NAME
FORMS = "afspm.forms"  # of experiment files: experiment.forms.FileForm
COMMANDS = "afspm.commands"  # afspm NAME: a function, or a typer.Typer
DRIFT_COMMANDS = "afspm.drift_commands"  # afspm drift NAME: as COMMANDS
PAGE_PARTS = "afspm.page_parts"  # of the page: see afspm.plugins.web.dashboard.page_parts
PAGES = "afspm.pages"  # `afspm run --dashboard`: a module with the functions of afspm.cli.run.RunPage

CLASSES = (COMPONENTS, SCHEDULERS, DRIVERS, EMULATORS)
"""Groups whose classes an experiment file may name without a module."""
_FILE = "entry_points.txt"
_OWN = "afspm"
_IN_FILES = (*CLASSES, ESTIMATORS, TRACKERS)
"""Groups whose names stand in experiment files: another package's object would change what the file means."""
_FOR_FILES = (READERS, EXPORTERS, FORMS)
_FOR_PROGRAMS = (FIGURES, DISPLAYS, FUNCTIONS, COMMANDS, DRIFT_COMMANDS, PAGES, PAGE_PARTS)
GROUPS = (*CLASSES, ESTIMATORS, TRACKERS, *_FOR_FILES, *_FOR_PROGRAMS)


@dataclass(frozen=True)
class DeclaredName:
    """A name that an installed package declares as an entry point, or a package whose names can't be read.

    Attributes:
        group, name: empty for a package whose names can't be read.
        package: name and version of the package.
        problem: reason why the name can't be used; empty if usable or not tried.
    """

    group: str
    name: str
    package: str
    problem: str = ""


def names(*groups: str) -> tuple[str, ...]:
    """Return all names that packages declare in these groups, sorted."""
    return tuple(sorted({point.name for point in _points(groups)}))


def find(name: str, *groups: str) -> EntryPoint | None:
    """Return the entry point with this name in one of the groups; None if no package declares the name.

    Outside experiment files a name of afspm stays afspm's, so that no package takes a reader or a command away.

    Raises:
        ConfigError: the name is declared for different objects.
    """
    # by value: two packages may declare the same object
    found = {point.value: point for point in _points(groups) if point.name == name}
    if len(found) > 1 and not {*groups} & {*_IN_FILES}:
        found = {value: point for value, point in found.items() if _package(point) == _OWN} or found
    if len(found) > 1:
        packages = sorted({_package(point) for point in found.values()})
        raise ConfigError(
            f"{name!r} is offered by several packages: {', '.join(packages)}",
            where=", ".join(sorted({point.group for point in found.values()})),
            hint="uninstall all but one of them",
        )
    return next(iter(found.values()), None)


def class_path(name: str) -> str | None:
    """Return the full path of a declared class, "package.module.Name"; None if no package declares the name.

    Raises:
        ConfigError: the name is declared for different classes.
    """
    point = find(name, *CLASSES)
    return None if point is None else f"{point.module}.{point.attr}"


def modules(*groups: str) -> tuple[str, ...]:
    """Return the modules that define the declared objects of these groups, sorted."""
    return tuple(sorted({point.module for point in _points(groups)}))


def is_declared(class_: type) -> bool:
    """Return whether a class, or one of its bases, is defined in a module of a declared class."""
    declared = modules(*CLASSES)
    return any(base.__module__ in declared for base in class_.__mro__)


def load(group: str, name: str) -> Any:
    """Import and return the object declared under a name; None if no package declares the name.

    Raises:
        ConfigError: the module can't be imported, or the name is declared for different objects.
    """
    point = find(name, group)
    return None if point is None else _loaded(point)


def required(group: str, name: str) -> Any:
    """Import and return an object that afspm itself declares.

    Raises:
        ConfigError: no package declares the name, the module can't be imported, or the name is declared for different
            objects.
    """
    found = load(group, name)
    if found is None:
        raise ConfigError(f"no installed package declares {name!r}", where=group, hint="install afspm again")
    return found


def folder(group: str, name: str) -> Path | None:
    """Return the folder of the module of a declared object, without importing the module; None if not found.

    Raises:
        ConfigError: the name is declared for different objects.
    """
    point = find(name, group)
    spec = None if point is None else find_spec(point.module)
    return None if spec is None or spec.origin is None else Path(spec.origin).parent


def inventory(taken_commands: Collection[str] = ()) -> tuple[DeclaredName, ...]:
    """Load the declared objects; return all declared names, each with the reason if it can't be used.

    The packages whose names can't be read come first. Names in unknown groups and names that afspm uses itself are not
    loaded.

    Args:
        taken_commands: afspm's own commands, which no package can replace.
    """
    found = [*unreadable()]
    for group, points in sorted(_installed().points.items(), key=lambda item: (item[0] not in GROUPS, item[0])):
        for point in sorted(points, key=lambda point: (_package(point), point.name)):
            problem = ""
            try:
                if group not in GROUPS:
                    problem = f"there is no such group, but {', '.join(GROUPS)}"
                elif group == COMMANDS and point.name in taken_commands:
                    problem = "afspm has a command of this name"
                else:
                    used = find(point.name, *(CLASSES if group in CLASSES else (group,)))
                    if used is not None and used.value != point.value:
                        problem = "afspm declares this name, too, and uses its own"
                    else:
                        _loaded(point)
            except ConfigError as error:
                problem = error.what
            found.append(DeclaredName(group, point.name, _package(point, with_version=True), problem))
    return tuple(found)


def unreadable() -> tuple[DeclaredName, ...]:
    """Return the installed packages whose names, or some of them, can't be read."""
    return tuple(_installed().unreadable)


@dataclass(frozen=True)
class _Installed:
    points: dict[str, list[EntryPoint]] = field(default_factory=dict)
    unreadable: list[DeclaredName] = field(default_factory=list)


@cache
def _installed() -> _Installed:
    from importlib import metadata  # imported late: it imports 40 modules, and most processes look up no name

    # metadata.entry_points() parses the entry points of all packages: 8 ms with 150 of them, this takes 2 ms
    found = _Installed()
    for package in metadata.distributions():
        try:
            _add(package, found)
        except Exception as error:  # malformed metadata raises errors of many types in the standard library
            problem = f"its metadata can't be read: {type(error).__name__}: {error}"
            found.unreadable.append(DeclaredName("", "", _place(package), problem))
            # pydantic reads the metadata of all packages at its first model, and fails with such a package among them
            os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")
    return found


def _add(package: Distribution, found: _Installed) -> None:
    declared = package.read_text(_FILE) or ""
    for line in map(str.strip, declared.splitlines()):
        if line and "=" not in line and not line.startswith(("[", "#")):
            raise ValueError(f"the line {line!r} of {_FILE} is not of the form name = module:object")
    if "[afspm." not in declared or not _is_first(package, declared):
        return
    of_afspm = [point for point in package.entry_points if point.group.startswith("afspm.")]
    for point in of_afspm:
        if point.pattern.match(point.value) is None:
            problem = f"{point.value!r} is not of the form module:object"
            found.unreadable.append(DeclaredName(point.group, point.name, _package(point), problem))
        else:
            found.points.setdefault(point.group, []).append(point)


def _place(package: Distribution) -> str:
    # the folder of the metadata: the name may be what can't be read
    return str(getattr(package, "_path", package.locate_file("")))


def _is_first(package: Distribution, declared: str) -> bool:
    from importlib.metadata import distribution

    # a package may be installed twice in sys.path: Python imports the first
    return distribution(package.name).read_text(_FILE) == declared


def forget() -> None:
    """Drop the cached metadata: the next look-up reads the installed packages again."""
    _installed.cache_clear()


def _points(groups: Iterable[str]) -> Iterable[EntryPoint]:
    return (point for group in groups for point in _installed().points.get(group, ()))


def _loaded(point: EntryPoint) -> Any:
    try:
        return point.load()
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a module may raise anything while it is imported, also SystemExit
        raise ConfigError(
            f"{point.name!r} of the package {_package(point)} can't be loaded: {type(error).__name__}: {error}",
            where=point.group,
        ) from error


def _package(point: EntryPoint, *, with_version: bool = False) -> str:
    if point.dist is None:
        return point.module
    return f"{point.dist.name} {point.dist.version}" if with_version else point.dist.name
