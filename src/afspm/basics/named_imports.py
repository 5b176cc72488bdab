"""Import of the modules that experiment files and launch lines name.

The record of another person is data: a name in it must not run code of its author, nor any module that happens to be
installed (`unittest.__main__` imports the tests of the current folder). Within `trusting_only`, names lead only to
modules in which installed packages declare classes for afspm, and to modules in given folders.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError


@dataclass(frozen=True)
class _Trust:
    folders: tuple[str, ...]
    loaded: frozenset[str]


_trust: _Trust | None = None


@contextmanager
def trusting_only(folders: Sequence[Path]) -> Iterator[None]:
    """Within the block, let names lead only to declared modules and to modules in `folders`; for all threads."""
    global _trust
    before, _trust = _trust, _Trust(tuple(map(str, folders)), frozenset(sys.modules))
    try:
        yield
    finally:
        _trust = before


def may_import(name: str) -> bool:
    """Return whether a name in a file may lead to a module."""
    return _trust is None or _is_trusted(name, _trust)


def import_named(name: str, *, of_process: bool = False) -> ModuleType:
    """Import the module that a file names.

    Args:
        of_process: the module of a process's class. It may also be one that the caller of afspm had imported before,
            since importing it again runs nothing.

    Raises:
        ConfigError: the module is not trusted.
        ImportError: there is no such module, or its own imports fail.
    """
    if not (may_import(name) or (of_process and _trust is not None and name in _trust.loaded)):
        raise ConfigError(
            f"{name} is not imported: this run is not known as one of yours, and no installed package declares the "
            "module for afspm",
            hint="if you trust the code, name its folder with --import-from (import_from=… in Python)",
        )
    return importlib.import_module(name)


def require_trusted(found: object, name: str) -> None:
    """Raise ConfigError if a class or function comes from a module that is not trusted, through an import elsewhere."""
    module = getattr(found, "__module__", None)
    if _trust is not None and not _is_trusted(str(module), _trust):
        raise ConfigError(f"{name} is not used: it is of the module {module}, and this run is not known as yours")


def _is_trusted(name: str, trust: _Trust) -> bool:
    if name in entry_points.modules(*entry_points.CLASSES, entry_points.ESTIMATORS, entry_points.TRACKERS):
        return True
    top = name.partition(".")[0]
    return PathFinder.find_spec(top, list(trust.folders)) is not None
