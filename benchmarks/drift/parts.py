"""The interface of this benchmark's parts: jobs for any process, and reports of their results.

A part is a module with `jobs(plan)`, which lists them, and `report(results)`, which evaluates their results. Jobs are
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
    """The extent of a benchmark.

    Attributes:
        seed: the first of the pairs' seeds.
        quick: an eighth of the pairs.
        estimators: by name, the one under test first; the others are for comparison.
    """

    seed: int
    quick: bool
    estimators: tuple[str, ...]

    @property
    def ours(self) -> str:
        return self.estimators[0]

    def seeds(self, count: int) -> range:
        """Return the seeds of `count` pairs, or of fewer in the quick version."""
        return range(self.seed, self.seed + (max(2, count // 8) if self.quick else count))


class Job(Protocol):
    """A piece of work for any process."""

    def run(self) -> Sequence[Any]:
        """Do the job; return its results for the part's report."""
        ...


@dataclass(frozen=True)
class Report:
    """The findings of a part: tables for a person, and lines with a target."""

    tables: list[Table]
    rows: list[Row] = field(default_factory=list)


class Part(Protocol):
    """A module of this package that measures something."""

    def jobs(self, plan: Plan) -> Sequence[Job]:
        """Return all jobs, the longest first."""
        ...

    def report(self, plan: Plan, results: Sequence[Any]) -> Report:
        """Return the report of the jobs' results, in their order."""
        ...
