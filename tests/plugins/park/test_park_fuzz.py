"""Random calls neither end the emulated SmartScan, nor spoil it, nor write outside its folder."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz import fuzz
from benchmarks.fuzz.park import ParkFuzzer
from rotation import ALL

from afspm.plugins.park.emulator import ParkEmulator

CALLS = 1000 if ALL else 300


def test_random_calls_are_survived(tmp_path: Path) -> None:
    outcome = fuzz(ParkFuzzer, ParkEmulator(port=0), tmp_path, CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20
