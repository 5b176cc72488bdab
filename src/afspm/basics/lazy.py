"""Names of a package that are imported on first use, so that a door costs a process only what goes through it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def lazily(package: str, names: Mapping[str, str], /, **renamed: str) -> Callable[[str], object]:
    """Return `__getattr__` for a package.

    Args:
        names: by module, the names that come from it, with spaces between; one may be a module in it.
        renamed: names that the package has under another: `write_report="afspm.report.night_report.write"`.
    """
    homes = {name: f"{module}.{name}" for module, several in names.items() for name in several.split()} | renamed

    def load(name: str) -> object:
        if (home := homes.get(name)) is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, own = home.rpartition(".")
        inside = import_module(module)
        thing = getattr(inside, own) if hasattr(inside, own) else import_module(home)
        setattr(sys.modules[package], name, thing)
        return thing

    return load
