"""Import of the classes named in an experiment file by `class = "module.Name"`, for its check and its start.

Only `class` and the few keys of the reference that name a function are imported; all other text stays text. The
published implementation imports any text with a dot, so `path = "scans.night"` can run a module.
"""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from afspm.basics import entry_points, named_imports, packages
from afspm.basics.errors import ConfigError
from afspm.experiment.findings import closest, nearest
from afspm.experiment.parts import DECLARED_KEYS
from afspm.experiment.toml_lines import Table
from afspm.model import Role

_OTHER_MAKE = "is it written for the published implementation? see docs/how-to/from-the-published-implementation.md"
_DOORS = (
    "afspm",
    "afspm.basics",
    "afspm.model",
    "afspm.driver",
    "afspm.emulation",
    "afspm.record",
    "afspm.components",
    "afspm.client",
    "afspm.cli",
    "afspm.supervisor",
    "afspm.transport",
)
# Roles by the package of a base class: a user's class is recognised by its bases.
_ROLE_BY_BASE = (
    ("afspm.scheduler", Role.SCHEDULER),
    ("afspm.translator", Role.TRANSLATOR),
    ("afspm.client.component", Role.COMPONENT),
)


@dataclass(frozen=True)
class ComponentDeclaration:
    """Declarations of a component: from its class attributes, or for a command from its table in the file."""

    solves: tuple[str, ...] = ()
    flags: tuple[str, ...] = ()
    publishes: tuple[str, ...] = ()
    listens: tuple[str, ...] | None = None
    needs_actions: tuple[str, ...] = ()
    needs_parameters: tuple[str, ...] = ()

    @classmethod
    def of_class(cls, component: type) -> ComponentDeclaration:
        return cls(
            **{key: names for key in DECLARED_KEYS if (names := _names(getattr(component, key, None))) is not None}
        )

    @classmethod
    def of_table(cls, table: Table) -> ComponentDeclaration:
        return cls(**{key: names for key in DECLARED_KEYS if (names := _names(table.get(key))) is not None})


class Unloadable(Exception):
    """An error in loading a class, with a message and a hint for the user."""

    def __init__(self, what: str, hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint


@contextlib.contextmanager
def importing_from(folders: Sequence[Path]) -> Iterator[None]:
    """Make modules beside the experiment file importable within the block.

    Two experiments may both have a `component.py`, so modules imported from the folders are unloaded afterwards.
    """
    before = set(sys.modules)
    added = [str(folder) for folder in folders]
    sys.path[:0] = added
    try:
        yield
    finally:
        for entry in added:
            with contextlib.suppress(ValueError):
                sys.path.remove(entry)
        for name in set(sys.modules) - before:
            if any(_is_from(folder, name) for folder in folders):
                del sys.modules[name]


def _is_from(folder: Path, name: str) -> bool:
    # a module of an environment (.venv) inside the folder is not the user's file
    file = getattr(sys.modules[name], "__file__", None)
    if not file:
        return False
    found, place = Path(file), folder.absolute().joinpath(*name.split("."))
    return found.parent / found.name.partition(".")[0] in (place, place / "__init__")


def full_path(name: str) -> str:
    """Return the full path of the class that a package declares under a bare name; return other paths unchanged.

    Raises:
        Unloadable: no package declares the class, or several do.
    """
    if "." in name:
        return name
    try:
        path = entry_points.class_path(name)
    except ConfigError as error:
        raise Unloadable(error.what, error.hint) from error
    if path is None:
        hint = packages.advice(name) or nearest(name, entry_points.names(*entry_points.CLASSES))
        hint = hint or 'write it as "module.Name"'
        for one in entry_points.unreadable():
            hint += f"; or it is of the package {one.package}: {one.problem}"
        raise Unloadable(f"there is no ready-made class {name!r}", hint)
    return path


def shipped_publishers(prefix: str) -> tuple[str, ...]:
    """Return afspm's classes that publish envelopes with a prefix, each as 'component with class = "Name"'."""
    found = []
    for name in entry_points.names(entry_points.COMPONENTS, entry_points.SCHEDULERS):
        path = full_path(name)
        if not path.startswith("afspm."):
            continue  # another package is not imported for a hint
        with contextlib.suppress(Unloadable):  # its extra is not installed
            declared = ComponentDeclaration.of_class(component := load(path))
            if (role := role_of(component)) and any(one.startswith(prefix) for one in declared.publishes):
                found.append(f'{role.value} with class = "{name}"')
    return tuple(found)


def load(path: str) -> Any:
    """Return the object `module.Name`.

    Raises:
        Unloadable: `path` has no dot, there is no such module or name, or its import fails.
    """
    module_name, _, name = path.rpartition(".")
    if not module_name or not name:
        raise Unloadable(f"{path!r} is not of the form module.Name")
    try:
        module = named_imports.import_named(module_name, of_process=True)
    except ConfigError as error:
        raise Unloadable(error.what, error.hint) from error
    except ModuleNotFoundError as error:
        if module_name.startswith("afspm.") and (advice := packages.advice(name)):  # as in files of older runs
            raise Unloadable(f"there is no module {module_name!r}", f'write class = "{name}"; {advice}') from error
        raise _no_module(module_name, error) from error
    except (Exception, SystemExit) as error:  # the user's module may do anything when imported, even exit
        raise Unloadable(f"importing {module_name} fails: {_error_line(error)}", _door_hint(error)) from error
    return _attribute(module, name)


def find_module(name: str, folders: Sequence[Path]) -> ModuleSpec | None:
    """Return the spec of a module, installed or in one of the folders; None if not found or not trusted."""
    if not named_imports.may_import(name):  # looking for a module of a package imports the package
        return None
    with importing_from(folders):
        try:
            return importlib.util.find_spec(name)
        except (ImportError, ValueError):
            return None


def role_of(component: type) -> Role | None:
    """Return the role of a class, by its bases or its attribute `role`; None if the class has no role."""
    for base in component.__mro__:
        for package, role in _ROLE_BY_BASE:
            if base.__module__ == package or base.__module__.startswith(package + "."):
                return role
    stated = getattr(component, "role", Role.COMPONENT)
    return stated if isinstance(stated, Role) and hasattr(component, "run_process") else None


def _attribute(module: ModuleType, name: str) -> Any:
    # packages may import a name lazily, by a module-level `__getattr__`
    try:
        return getattr(module, name)
    except AttributeError:
        is_ours = module.__name__.partition(".")[0] == "afspm" and _has_bare_name(name)
        hint = f'write class = "{name}"' if is_ours else _shadowing_hint(module)
        hint = hint or nearest(name, getattr(module, "__all__", None) or _public_classes(module))
        raise Unloadable(f"{module.__name__} has no {name!r}", hint) from None
    except ModuleNotFoundError as error:
        raise _no_module(f"{module.__name__}.{name}", error) from error
    except (Exception, SystemExit) as error:  # a lazy import may run the user's code, too
        raise Unloadable(f"importing {name} fails: {_error_line(error)}") from error


def _has_bare_name(name: str) -> bool:
    try:
        return full_path(name) != name
    except Unloadable:
        return False


def _shadowing_hint(module: ModuleType) -> str:
    # Python imported another module of this name instead of the user's file.
    for folder in sys.path:
        file = Path(folder, f"{module.__name__}.py")
        if file.exists():
            own = getattr(module, "__file__", None)
            return (
                "" if own and file.samefile(own) else f"Python imported another module of this name: rename {file.name}"
            )
    return ""


def _door_hint(error: BaseException) -> str:
    # ImportError has the name as an attribute from Python 3.12 on
    found = re.match(r"cannot import name '(\w+)' from '(?=afspm\b)", str(error))
    named = found[1] if found and isinstance(error, ImportError) else ""
    doors = [door for door in _DOORS if named in getattr(importlib.import_module(door), "__all__", ())]
    return f"write `from {doors[0]} import {named}`" if doors else ""


def _no_module(module: str, error: ModuleNotFoundError) -> Unloadable:
    missing = error.name or module
    if module != missing and not module.startswith(missing + "."):
        package = missing.partition(".")[0]
        if package == "afspm":
            return Unloadable(f"{module} needs {missing!r}, which afspm does not have", _OTHER_MAKE)
        hint = "" if package == module.partition(".")[0] else f"if it is spelt right: pip install {missing}"
        return Unloadable(f"importing {module} fails: it needs {missing!r}, which is not installed", hint)
    parent, _, last = missing.rpartition(".")
    siblings: list[str] = []
    for folder in _search_paths(parent):
        with contextlib.suppress(OSError):
            siblings += [p.stem for p in Path(folder).iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()]
    near = closest(last, siblings, 0.7)
    beside = f"write {last}.py beside the experiment file" if not parent else ""
    hint = f"did you mean {(parent + '.' if parent else '') + near!r}?" if near else beside
    return Unloadable(f"there is no module {missing!r}", hint)


def _search_paths(parent: str) -> list[str]:
    if not parent:
        return sys.path
    try:
        spec = importlib.util.find_spec(parent)
    except (ImportError, ValueError):
        return []
    return list(spec.submodule_search_locations or ()) if spec else []


def _error_line(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    message = str(error)
    if isinstance(error, SyntaxError) and error.filename:
        place, message = f" ({Path(error.filename).name}:{error.lineno})", error.msg
    return f"{type(error).__name__}: {message}{place}"


def _public_classes(module: ModuleType) -> list[str]:
    return [n for n, v in vars(module).items() if inspect.isclass(v) and not n.startswith("_")]


def _names(value: object) -> tuple[str, ...] | None:
    if value is None or isinstance(value, property):
        return None
    if isinstance(value, str):
        return (value,)
    if isinstance(value, list | tuple | set | frozenset):
        return tuple(item if isinstance(item, str) else getattr(item, "name", str(item)) for item in value)
    return None
