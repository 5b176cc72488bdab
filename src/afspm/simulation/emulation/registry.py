"""The emulators by the names that a command line uses: of "NanonisEmulator", `afspm emulate nanonis`."""

from __future__ import annotations

import importlib
from types import ModuleType

from afspm.basics import entry_points
from afspm.basics.errors import ConfigError
from afspm.simulation.emulation.emulator import Emulator


def names() -> list[str]:
    """Return the names of the emulators that installed packages declare."""
    return sorted(map(_spoken, entry_points.names(entry_points.EMULATORS)))


def emulator(name: str) -> type[Emulator]:
    """Return the emulator of a name, or one of the user's by "module.Class".

    Raises:
        ConfigError: there is none, or it can't be imported.
    """
    module_name, _, class_name = name.rpartition(".")
    if module_name:
        found = getattr(_imported(module_name, name), class_name, None)
    else:
        declared = {_spoken(one): one for one in entry_points.names(entry_points.EMULATORS)}
        if name not in declared:
            raise ConfigError(f"there is no emulator {name!r}", hint=f"there are {', '.join(declared) or 'none'}")
        found = entry_points.load(entry_points.EMULATORS, declared[name])
    if not (isinstance(found, type) and issubclass(found, Emulator)):
        raise ConfigError(
            f"{name} is not an emulator", hint="a class derived from afspm.simulation.emulation.emulator.Emulator"
        )
    return found


def _spoken(class_name: str) -> str:
    return class_name.removesuffix("Emulator").lower()


def _imported(module: str, name: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"the emulator {name} can't be imported: {error}", hint="is it installed, or on the path?"
        ) from error
