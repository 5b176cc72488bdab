"""afspm automates scanning probe microscopes of any make.

What one writes components and scripts with is here, loaded when it is first used, so that every process starts fast.
"""

from __future__ import annotations

from importlib.machinery import PathFinder
from typing import TYPE_CHECKING, Any

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.client.component import Component
    from afspm.client.connect import connect
    from afspm.client.events import Events, PublishedEvent
    from afspm.client.scope import Scope
    from afspm.model import ControlMode, Problem, Region, Scan, ScanSet, ScopeState, Spectrum
    from afspm.night.catalogue import find_runs
    from afspm.night.run import Run, open_run
    from afspm.storage.formats import read
    from afspm.storage.memory import Memory

__all__ = [
    "Component",
    "ControlMode",
    "Events",
    "Memory",
    "Problem",
    "PublishedEvent",
    "Region",
    "Run",
    "Scan",
    "ScanSet",
    "Scope",
    "ScopeState",
    "Spectrum",
    "connect",
    "find_runs",
    "open_run",
    "read",
]
_own = lazily(
    __name__,
    {
        "afspm.client.component": "Component",
        "afspm.client.connect": "connect",
        "afspm.client.events": "Events PublishedEvent",
        "afspm.client.scope": "Scope",
        "afspm.model": "ControlMode Problem Region Scan ScanSet ScopeState Spectrum",
        "afspm.night.catalogue": "find_runs",
        "afspm.night.run": "Run open_run",
        "afspm.storage.formats": "read",
        "afspm.storage.memory": "Memory",
    },
)


def __getattr__(name: str) -> Any:
    if name in __all__:
        return _own(name)
    # a function that a package adds, so that notebooks need no path of a guest; never under a name of Python's own, nor
    # of a module here: `from afspm import wire` asks for the name first, and must not read all packages' metadata
    if not name.startswith("_") and PathFinder.find_spec(f"{__name__}.{name}", __path__) is None:
        from afspm.basics import entry_points, packages

        if (found := entry_points.load(entry_points.FUNCTIONS, name)) is not None:
            return found
        if remedy := packages.advice(name):
            raise AttributeError(f"module 'afspm' has no attribute {name!r}: {remedy}")
    raise AttributeError(f"module 'afspm' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([name for name in globals() if name not in __all__] + list(__all__))
