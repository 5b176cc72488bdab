"""Automation of scanning probe microscopes, whoever made them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from afspm.runtime.connect import connect

__all__ = ["connect"]


def __getattr__(name: str) -> Any:
    """`afspm.connect`, imported when it is used: every process of an experiment imports this package."""
    if name == "connect":
        from afspm.runtime.connect import connect

        return connect
    raise AttributeError(f"module 'afspm' has no attribute {name!r}")
