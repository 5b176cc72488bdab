"""Packages of the folder `packages/`, which `pip install .` leaves out, and the names that they bring."""

from __future__ import annotations

from typing import Final

BROUGHT_BY: Final = {
    "Agent": "afspm-agents",
    "agent": "afspm-agents",
    "approve": "afspm-agents",
    "drift study": "afspm-lab",
    "what-if": "afspm-lab",
    "what_if": "afspm-lab",
}
"""The package of each command, function and class that may be missing."""


def remedy(name: str) -> str:
    """Return how a missing name is installed, for a person; empty if no package of this repository brings it."""
    package = BROUGHT_BY.get(name)
    return f"pip install ./packages/{package} in the folder of the clone" if package else ""
