"""Fixtures for tests of Park."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.plugins.park.park_bench import Bench
from tests.plugins.vendor_bench import benches

pytest.importorskip("quickjs", reason="the emulated SmartScan runs scripts in JavaScript: pip install afspm[park]")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    yield from benches(Bench, tmp_path)
