"""Plug-ins: what installed packages add to afspm, by Python entry points.

A package declares them in its `pyproject.toml`, in one of the groups below; installing it is all that is needed::

    [project.entry-points."afspm.components"]
    Ridges = "my_lab.ridges:Ridges"

Nothing is imported until its name is used.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any

from afspm.errors import ConfigError

DRIVERS = "afspm.drivers"  # class = "Name" of a translator
COMPONENTS = "afspm.components"  # class = "Name" of a component
READERS = "afspm.readers"  # by the suffix of a file, without its dot: (path, zone) -> FileContent
ESTIMATORS = "afspm.estimators"  # of drift, by name
FORMS = "afspm.forms"  # of experiment files: experiment.forms.FileForm
COMMANDS = "afspm.commands"  # afspm NAME: a function, or a typer.Typer


def names(group: str) -> tuple[str, ...]:
    """Return the names of a group, sorted."""
    return tuple(sorted({point.name for point in entry_points(group=group)}))


def find(group: str, name: str) -> EntryPoint | None:
    """Return the entry point of a name; None if no package has it.

    Raises:
        ConfigError: two packages have it.
    """
    found = {point.value: point for point in entry_points(group=group, name=name)}
    if len(found) > 1:
        packages = sorted(point.dist.name if point.dist else value for value, point in found.items())
        raise ConfigError(
            f"{name!r} is offered by several packages: {', '.join(packages)}",
            where=group,
            hint="uninstall all but one of them",
        )
    return next(iter(found.values()), None)


def class_path(group: str, name: str) -> str | None:
    """Return what a name stands for as "package.module.Name", without importing it; None if no package has it."""
    point = find(group, name)
    return None if point is None else f"{point.module}.{point.attr}"


def load(group: str, name: str) -> Any:
    """Import what a name stands for; None if no package has it.

    Raises:
        ConfigError: it can't be imported, or two packages have it.
    """
    point = find(group, name)
    if point is None:
        return None
    try:
        return point.load()
    except Exception as error:  # a module may raise anything while it is imported
        package = point.dist.name if point.dist else point.module
        raise ConfigError(
            f"{name!r} of the package {package} can't be loaded: {type(error).__name__}: {error}", where=group
        ) from error
