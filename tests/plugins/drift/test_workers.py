"""Tasks are done in spite of dead workers."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from systems import not_on_wine

from afspm.basics import InvalidValue
from afspm.plugins.drift.workers import TaskOutcome, on_cores, processes


def doubled(number: int) -> int:
    if number < 0:
        raise InvalidValue("below zero")
    return 2 * number


def doubled_by_the_next(number: int, marks: Path) -> int:
    """The first worker that is given 3 dies."""
    mark = marks / "died"
    if number == 3 and not mark.exists():
        mark.touch()
        os._exit(9)
    return 2 * number


def deadly(number: int) -> int:
    os._exit(9)


def by_index(outcomes: list[TaskOutcome]) -> list[TaskOutcome]:
    return sorted(outcomes, key=lambda outcome: outcome.index)


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_task_is_done_and_an_error_is_reported_for_its_task_alone(jobs: int) -> None:
    done = by_index(list(on_cores(doubled, [(1,), (-1,), (3,)], jobs=jobs)))
    assert done == [TaskOutcome(0, 2), TaskOutcome(1, error="below zero"), TaskOutcome(2, 6)]


def test_the_number_of_processes_is_the_given_one_or_one_where_more_do_not_pay() -> None:
    assert [processes(3, pixels) for pixels in (1, 10**9)] == [3, 3]
    assert processes(None, 32 * 32) == 1
    assert processes(None, 10**9) == (os.cpu_count() or 1)


@not_on_wine("a pool of processes does not hear of the end of one that was killed")
def test_a_killed_worker_loses_no_task(tmp_path: Path) -> None:
    done = by_index(list(on_cores(doubled_by_the_next, [(n, tmp_path) for n in range(6)], jobs=2)))
    assert [outcome.value for outcome in done] == [2 * n for n in range(6)]
    assert (tmp_path / "died").exists()


@not_on_wine("a pool of processes does not hear of the end of one that was killed")
def test_a_task_that_kills_every_worker_is_reported_and_not_retried_for_ever() -> None:
    done = list(on_cores(deadly, [(1,), (2,)], jobs=2))
    assert len(done) == 2
    assert all("died 3 times" in outcome.error for outcome in done)
