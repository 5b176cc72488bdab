"""afspm automates scanning probe microscopes of any make.

What one writes components and scripts with is here, loaded when it is first used, so that every process starts fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from afspm.client.component import Component
    from afspm.client.connect import connect
    from afspm.client.scope import Scope
    from afspm.model import ControlMode, Problem, Region, Scan, ScanSet, ScopeState, Spectrum
    from afspm.record.catalogue import find_runs
    from afspm.record.run import open_run
    from afspm.storage.formats import read

__all__ = [
    "Component",
    "ControlMode",
    "Problem",
    "Region",
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

_HOMES = {
    "Component": "afspm.client.component",
    "Scope": "afspm.client.scope",
    "connect": "afspm.client.connect",
    "find_runs": "afspm.record.catalogue",
    "open_run": "afspm.record.run",
    "read": "afspm.storage.formats",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        from afspm.basics import entry_points

        # a function that a package adds; never under a name of Python's own
        if not name.startswith("_") and (found := entry_points.load(entry_points.FUNCTIONS, name)) is not None:
            return found
        raise AttributeError(f"module 'afspm' has no attribute {name!r}")
    return getattr(import_module(_HOMES.get(name, "afspm.model")), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
