"""Random scripts do not end the emulated Studio, nor leave it unfit, nor write outside its folder."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz import fuzz
from benchmarks.fuzz.nanosurf import NanosurfFuzzer

from afspm.emulators.nanosurf import NanosurfEmulator

CALLS = 1500


def test_random_scripts_are_survived(tmp_path: Path) -> None:
    outcome = fuzz(NanosurfFuzzer, NanosurfEmulator(port=0), tmp_path, CALLS)
    assert min(outcome.answered, outcome.refused) > CALLS / 20
