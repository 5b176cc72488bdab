"""Random calls neither end the emulated GXSM, nor spoil it, nor write outside its folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from benchmarks.fuzz import fuzz
from benchmarks.fuzz.gxsm import GxsmFuzzer
from rotation import ALL

from afspm.plugins.gxsm.emulator import GxsmEmulator

CALLS = 1000 if ALL else 300
KINDS: list[dict[str, Any]] = [{"version": 3}, {"version": 4, "transport": "shm"}]


@pytest.mark.parametrize("kind", KINDS, ids=["gxsm3-bridge", "gxsm4-shm"])
def test_random_calls_are_survived(tmp_path: Path, kind: dict[str, Any]) -> None:
    if "transport" in kind and not sys.platform.startswith("linux"):
        pytest.skip("Gxsm4's shared memory is there on Linux alone")
    outcome = fuzz(GxsmFuzzer, GxsmEmulator(**kind), tmp_path / "run", CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20
