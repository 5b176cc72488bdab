"""Conformance suites, commissioning, skeletons and a bench, for authors of drivers, components and clients.

No process of a run imports this package. `Bench` is loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.basics.lazy import lazily

if TYPE_CHECKING:
    from afspm.testing.components.component_bench import Bench

__all__ = ["Bench"]

if not TYPE_CHECKING:
    __getattr__ = lazily(__name__, {"afspm.testing.components.component_bench": "Bench"})
