from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture
def cluster() -> Iterator[str]:
    """The address of a Dask cluster of two workers on this computer."""
    distributed = pytest.importorskip("distributed", reason="needs Dask, the extra `study`")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        scheduler_port=0,
        dashboard_address=None,
        scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # it serves its state even so, else at a fixed port
    ) as made:
        yield made.scheduler_address
