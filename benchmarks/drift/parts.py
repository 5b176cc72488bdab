"""What the parts of this benchmark are made of: jobs that any process can do, and reports of what came of them.

A part is a module with `jobs(plan)`, which lists them, and `report(results)`, which reads what they gave. Jobs are
frozen dataclasses, so that they can be sent to another process.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from rich.table import Table

from benchmarks.rows import Row


@dataclass(frozen=True)
class Plan:
    """How much is to be done.

    Attributes:
        seed: the first of the pairs' seeds.
        quick: an eighth of the pairs.
        estimators: by name, ours first; the others are there to compare with.
    """

    seed: int
    quick: bool
    estimators: tuple[str, ...]

    @property
    def ours(self) -> str:
        return self.estimators[0]

    def seeds(self, count: int) -> range:
        """Of so many pairs, fewer in the quick version."""
        return range(self.seed, self.seed + (max(2, count // 8) if self.quick else count))


class Job(Protocol):
    """Something to do in any process."""

    def run(self) -> Sequence[Any]:
        """Do it; what comes back goes to the part's report."""
        ...


@dataclass(frozen=True)
class Report:
    """What a part found: tables for a person, and lines with a target."""

    tables: list[Table]
    rows: list[Row] = field(default_factory=list)


class Part(Protocol):
    """A module of this package that measures something."""

    def jobs(self, plan: Plan) -> Sequence[Job]:
        """All there is to do, the longest first."""
        ...

    def report(self, plan: Plan, results: Sequence[Any]) -> Report:
        """Of all that the jobs gave, in their order."""
        ...
