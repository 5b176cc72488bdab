"""Packages of the folder `packages/`, which `pip install .` leaves out, by the names that they bring."""

from __future__ import annotations

from typing import Final

BROUGHT_BY: Final[dict[str, str]] = {
    **dict.fromkeys(("Agent", "agent", "approve"), "afspm-agents"),
    **dict.fromkeys(("drift study", "what-if", "what_if"), "afspm-lab"),
    **dict.fromkeys(
        ("PublishedPeers", "PublishedScheduler", "PublishedTranslator", "SimulatedPublishedTranslator"),
        "afspm-published",
    ),
}
"""The package of each class of an experiment file, command and function that may be missing."""


def advice(name: str) -> str:
    """Return which package brings a name, and how to install the package; empty if none does."""
    package = BROUGHT_BY.get(name)
    return f"the package {package} has it: in the clone of afspm, pip install ./packages/{package}" if package else ""
