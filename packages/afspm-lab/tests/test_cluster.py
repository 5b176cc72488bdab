"""Tasks and studies on a Dask cluster, started once for all of these tests."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_study_command import SMALL, told
from tests.plugins.drift.test_workers import by_index, doubled, doubled_by_the_next

from afspm.basics import ConfigError
from afspm.plugins.drift.workers import TaskOutcome
from afspm_lab.study import on_cluster

pytestmark = pytest.mark.slow  # each worker imports Dask; `test_workers.py` has those without

NEEDED: dict[str, Any] = {"modname": "distributed", "reason": "needs Dask, the extra `study`"}


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a cluster of two workers on this computer."""
    distributed = pytest.importorskip(**NEEDED)
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        scheduler_port=0,
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # it serves its state even so, else at a fixed port
    ) as made:
        yield made.scheduler_address


def test_a_cluster_loses_no_task_with_a_dead_worker(cluster: str, tmp_path: Path) -> None:
    tasks = [(n, tmp_path) for n in range(6)]
    done = by_index(list(on_cluster(doubled_by_the_next, tasks, address=cluster)))
    failed = list(on_cluster(doubled, [(-1,)], address=cluster))
    assert [outcome.value for outcome in done] == [2 * n for n in range(6)]
    assert (tmp_path / "died").exists()
    assert failed == [TaskOutcome(0, error="below zero")]


def test_a_study_on_a_cluster_gives_the_same_result(cluster: str) -> None:
    here = told(*SMALL, "-n", "2", "-j", "1")
    assert told(*SMALL, "-n", "2", "--cluster", cluster) == here


def test_a_missing_cluster_is_reported() -> None:
    pytest.importorskip(**NEEDED)
    with pytest.raises(ConfigError, match="no cluster"):
        list(on_cluster(doubled, [(1,)], address="nonsense://nowhere"))
