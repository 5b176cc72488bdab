"""Conformance suites, commissioning, skeletons and a bench, for authors of drivers, components and clients.

No process of a run imports this package. `Bench` is loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.testing.components.component_bench import Bench

__all__ = ["Bench"]


def __getattr__(name: str) -> object:
    if name != "Bench":
        raise AttributeError(f"module 'afspm.testing' has no attribute {name!r}")
    from afspm.testing.components.component_bench import Bench

    return Bench
