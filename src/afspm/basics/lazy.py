"""Names of a package that are imported on first use, so that a door costs a process only what goes through it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path

_IMPORT = re.compile(r"^    from (\S+) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


def lazily(package: str) -> Callable[[str], object]:
    """Return `__getattr__` for a package that imports its names under TYPE_CHECKING, and has no other import there."""

    @cache
    def homes() -> dict[str, tuple[str, str]]:
        found = {}
        for module, several, line in _IMPORT.findall(Path(str(sys.modules[package].__file__)).read_text("utf-8")):
            for name in re.findall(r"\w+(?: as \w+)?", several or line.partition("#")[0]):
                own, _, renamed = name.partition(" as ")
                found[renamed or own] = (module, own)
        return found

    def load(name: str) -> object:
        if (home := homes().get(name)) is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, own = home
        inside = import_module(module)
        thing = getattr(inside, own) if hasattr(inside, own) else import_module(f"{module}.{own}")
        setattr(sys.modules[package], name, thing)
        return thing

    return load
