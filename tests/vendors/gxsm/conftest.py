"""Fixtures for the tests of GXSM."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from gxsm_bench import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    with ExitStack() as stack:

        def make(speed: float = 100.0, **emulator: Any) -> Bench:
            return Bench(tmp_path, stack, speed, emulator)

        yield make
