"""Random calls neither end the emulated Asylum, nor spoil it, nor write outside its folder."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz import fuzz
from benchmarks.fuzz.asylum import AsylumFuzzer

from afspm.plugins.asylum.emulator import AsylumEmulator

CALLS = 2000


def test_random_calls_are_survived(tmp_path: Path) -> None:
    outcome = fuzz(AsylumFuzzer, AsylumEmulator(port=0), tmp_path, CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20
