"""Execution of many independent tasks on this computer's cores.

Tasks of dead workers are repeated.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from afspm.basics import AfspmError

_FEW_PIXELS = 100_000  # of all scans: up to here, starting processes takes longer than the registration
_MOST_DEATHS = 3  # of workers in a row without a finished task


@dataclass(frozen=True)
class TaskOutcome:
    """The result or the error of a task.

    Attributes:
        index: index of the task.
        value: return value of the task; None for a failed task.
        error: error text, for people; empty if the task succeeded.
    """

    index: int
    value: Any = None
    error: str = ""


def processes(asked: int | None, pixels: int) -> int:
    """Return the requested number of processes; by default one per core if the scans are large enough, else 1."""
    if asked is not None:
        return asked
    return 1 if pixels <= _FEW_PIXELS else os.cpu_count() or 1


def on_cores(
    function: Callable[..., object], tasks: Sequence[tuple[object, ...]], *, jobs: int
) -> Iterator[TaskOutcome]:
    """Yield the outcomes of `function(*task)` in any order, computed in `jobs` processes (1: in this process).

    After three deaths of workers in a row without a finished task, all remaining tasks fail.
    """
    if jobs <= 1:
        for index, task in enumerate(tasks):
            yield outcome_of(function, index, task)
        return
    left = dict(enumerate(tasks))
    deaths = 0
    while left:
        before = len(left)
        for outcome in _until_one_dies(function, left, jobs):
            del left[outcome.index]
            yield outcome
        deaths = 0 if len(left) < before else deaths + 1
        if deaths >= _MOST_DEATHS:
            died = f"worker processes died {deaths} times one after the other (too little memory?)"
            yield from (TaskOutcome(index, error=died) for index in left)
            return


def _until_one_dies(
    function: Callable[..., object], left: dict[int, tuple[object, ...]], jobs: int
) -> Iterator[TaskOutcome]:
    # a dead worker breaks the whole pool
    # spawn: the same on all systems, and no copy of numpy's threads in an undefined state
    with ProcessPoolExecutor(min(jobs, len(left)), mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            futures = [pool.submit(outcome_of, function, index, task) for index, task in left.items()]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            return
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def outcome_of(function: Callable[..., object], index: int, task: tuple[object, ...]) -> TaskOutcome:
    """Return the outcome of `function(*task)`, an error as text: not every exception can be pickled."""
    try:
        return TaskOutcome(index, function(*task))
    except Exception as error:  # a task may run a user's own estimator, which may raise anything
        return TaskOutcome(index, error=error_text(error))


def error_text(error: BaseException) -> str:
    return str(error) if isinstance(error, AfspmError) else f"{type(error).__name__}: {error}"
