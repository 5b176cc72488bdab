"""Packages of this repository that a plain installation does not have, by the names that they bring."""

from __future__ import annotations

from typing import Final

BROUGHT_BY: Final[dict[str, str]] = dict.fromkeys(
    ("PublishedPeers", "PublishedScheduler", "PublishedTranslator", "SimulatedPublishedTranslator"), "afspm-published"
)
"""Package in the folder `packages/`, by the name of an entry point: a class of an experiment file, or a command."""


def advice(name: str) -> str:
    """Return which package brings a name, and how to install the package; empty if none does."""
    package = BROUGHT_BY.get(name)
    return f"the package {package} has it: in the clone of afspm, pip install ./packages/{package}" if package else ""
