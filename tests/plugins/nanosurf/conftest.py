"""Fixtures for tests of Nanosurf."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from tests.plugins.nanosurf.nanosurf_bench import Bench
from tests.plugins.vendor_bench import benches

pytest.importorskip("lupa", reason="the emulated Studio runs scripts in lupa's Lua: pip install afspm[nanosurf]")


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    yield from benches(Bench, tmp_path)
