"""A string that equals a top-level key stands for that key's value, as in the paper.

Only whole strings count, and only keys that hold a variable or an intermediary table: components and the sections
of `sections.py` are no values, so that a component may be named (in a role, in a limit) without being pasted in.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from afspm.experiment.document import Document
from afspm.experiment.toml_lines import Path


class VariableReferences:
    """Replaces references in values; reports cycles; remembers which keys were used."""

    def __init__(self, document: Document, variables: Mapping[str, Any]) -> None:
        self._document = document
        self._variables = variables
        self.used: set[str] = set()

    def expand(self, value: Any, path: Path) -> Any:
        """`value`, which stands at `path`, with every reference in it replaced, again and again."""
        return self._expand(value, path, ())

    def _expand(self, value: Any, path: Path, through: tuple[str, ...]) -> Any:
        if isinstance(value, dict):
            return {key: self._expand(item, (*path, key), through) for key, item in value.items()}
        if isinstance(value, list):
            return [self._expand(item, (*path, i), through) for i, item in enumerate(value)]
        if not isinstance(value, str) or value not in self._variables:
            return value
        if value in through:
            self._report_cycle((*through[through.index(value) :], value))
            return value
        self.used.add(value)
        return self._expand(self._variables[value], (value,), (*through, value))

    def _report_cycle(self, around: tuple[str, ...]) -> None:
        # the same ring is met from each of its keys: begin it at its smallest name, so that it is reported once
        ring = around[:-1]
        start = ring.index(min(ring))
        ring = ring[start:] + ring[:start]
        what = " -> ".join((*ring, ring[0]))
        self._document.error(f"the references go in a circle: {what}", ring[0])
