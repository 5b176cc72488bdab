"""Malicious requests; `make soak` makes more of them."""

from __future__ import annotations

from pathlib import Path

from benchmarks.fuzz import fuzz
from benchmarks.fuzz.nanonis import NanonisFuzzer

from afspm.plugins.nanonis.emulator import NanonisEmulator


def test_random_requests_neither_end_the_emulator_nor_write_elsewhere(tmp_path: Path) -> None:
    outcome = fuzz(NanonisFuzzer, NanonisEmulator(port=0), tmp_path, 2000, seed=7)
    assert outcome.answered > 500
    assert outcome.refused > 500
