"""Fixtures for tests of Asylum."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from asylum_bench import Bench
from vendor_bench import benches


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    yield from benches(Bench, tmp_path)
