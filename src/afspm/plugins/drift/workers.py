"""Execution of many independent tasks on this computer's cores or a Dask cluster.

Tasks of dead workers are repeated.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from afspm.basics import AfspmError, ConfigError

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
            yield _done(function, index, task)
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


def on_cluster(
    function: Callable[..., object], tasks: Sequence[tuple[object, ...]], *, address: str
) -> Iterator[TaskOutcome]:
    """Yield outcomes like `on_cores`, computed by a Dask cluster with the same version of afspm.

    The task of a dead worker is given to another worker.

    Raises:
        ConfigError: `distributed` is not installed, or the address does not answer.
    """
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise ConfigError("a cluster needs Dask", hint='pip install "afspm[study]"') from error
    try:
        client = distributed.Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"no cluster can be reached: {error}", where=address) from error
    with client:
        futures = {client.submit(_done, function, index, task, pure=False): index for index, task in enumerate(tasks)}
        for future in distributed.as_completed(list(futures), loop=client.loop):
            yield _result(future, futures[future])
            future.release()


def _until_one_dies(
    function: Callable[..., object], left: dict[int, tuple[object, ...]], jobs: int
) -> Iterator[TaskOutcome]:
    # a dead worker breaks the whole pool
    # spawn: the same on all systems, and no copy of numpy's threads in an undefined state
    with ProcessPoolExecutor(min(jobs, len(left)), mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            futures = [pool.submit(_done, function, index, task) for index, task in left.items()]
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool:
            return
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _result(future: Any, index: int) -> TaskOutcome:
    # a task is done again if its worker died before the result was fetched
    try:
        outcome: TaskOutcome = future.result()
    except Exception as error:  # errors of the cluster itself, of any kind: errors of the task are in its outcome
        return TaskOutcome(index, error=_error_text(error))
    return outcome


def _done(function: Callable[..., object], index: int, task: tuple[object, ...]) -> TaskOutcome:
    # errors are returned as text: not every exception can be pickled
    try:
        return TaskOutcome(index, function(*task))
    except Exception as error:  # a task may run a user's own estimator, which may raise anything
        return TaskOutcome(index, error=_error_text(error))


def _error_text(error: BaseException | None) -> str:
    return str(error) if isinstance(error, AfspmError) else f"{type(error).__name__}: {error}"
