"""Execution of many independent tasks on a Dask cluster."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from afspm.basics import ConfigError
from afspm.plugins.drift.workers import TaskOutcome, error_text, outcome_of


def on_cluster(
    function: Callable[..., object], tasks: Sequence[tuple[object, ...]], *, address: str
) -> Iterator[TaskOutcome]:
    """Yield the outcomes of `function(*task)` in any order, computed by a Dask cluster with the same version of afspm.

    The task of a dead worker is given to another worker.

    Raises:
        ConfigError: `distributed` is not installed, or the address does not answer.
    """
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        hint = 'pip install "./packages/afspm-lab[study]" in the folder of the clone'
        raise ConfigError("a cluster needs Dask", hint=hint) from error
    try:
        client = distributed.Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"no cluster can be reached: {error}", where=address) from error
    with client:
        futures = {client.submit(outcome_of, function, n, task, pure=False): n for n, task in enumerate(tasks)}
        for future in distributed.as_completed(list(futures), loop=client.loop):
            yield _result(future, futures[future])
            future.release()


def _result(future: Any, index: int) -> TaskOutcome:
    # a task is done again if its worker died before the result was fetched
    try:
        outcome: TaskOutcome = future.result()
    except Exception as error:  # errors of the cluster itself, of any kind: errors of the task are in its outcome
        return TaskOutcome(index, error=error_text(error))
    return outcome
