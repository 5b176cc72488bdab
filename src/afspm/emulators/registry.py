"""The emulators that there are, by the names that a command line uses. Each is only imported when it is wanted."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from afspm import emulators
from afspm.emulators.emulator import Emulator
from afspm.errors import ConfigError

CONSTANT = "EMULATOR"
"""A package of an emulator says by this name which of its classes it is."""


def names() -> list[str]:
    """Return the names of afspm's emulators: the packages beside this module."""
    return sorted(module.name for module in pkgutil.iter_modules(emulators.__path__) if module.ispkg)


def emulator(name: str) -> type[Emulator]:
    """The emulator of a name, or one of the user's by "module.Class".

    Raises:
        ConfigError: there is none, or it can't be imported.
    """
    module_name, _, class_name = name.rpartition(".")
    if not module_name:
        if name not in names():
            raise ConfigError(f"there is no emulator {name!r}", hint=f"there are {', '.join(names()) or 'none'}")
        module_name, class_name = f"{emulators.__name__}.{name}", CONSTANT
    found = getattr(_imported(module_name, name), class_name, None)
    if not (isinstance(found, type) and issubclass(found, Emulator)):
        raise ConfigError(f"{name} is not an emulator", hint="a class derived from afspm.emulators.emulator.Emulator")
    return found


def _imported(module: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the emulator {name} can't be imported: {error}", hint="is it installed, or on the path?"
        ) from error
