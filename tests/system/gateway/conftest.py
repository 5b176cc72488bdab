from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.system.gateway.gateway_lab import GatewayRun

Started = Callable[..., GatewayRun]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Started]:
    """Starts an experiment with a gateway; killed after the test."""
    runs: list[GatewayRun] = []

    def start(more: str = "", **options: Any) -> GatewayRun:
        runs.append(GatewayRun(tmp_path, more, **options))
        return runs[-1]

    yield start
    for one in runs:
        one.close()
