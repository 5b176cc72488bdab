from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.system.agent.agent_lab import AgentRun

Started = Callable[..., AgentRun]


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Started]:
    """Starts an experiment with an agent server; killed after the test."""
    runs: list[AgentRun] = []

    def start(more: str = "", **options: Any) -> AgentRun:
        runs.append(AgentRun(tmp_path, more, **options))
        return runs[-1]

    yield start
    for one in runs:
        one.close()
