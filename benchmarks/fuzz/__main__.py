"""`python -m benchmarks.fuzz [COUNT [SEED]]`: random calls (default: 50,000) of every vendor's emulator."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from afspm.emulators.asylum import AsylumEmulator
from afspm.emulators.emulator import Emulator
from afspm.emulators.gxsm import GxsmEmulator
from afspm.emulators.nanonis import NanonisEmulator
from afspm.emulators.nanosurf import NanosurfEmulator
from benchmarks.fuzz.asylum import AsylumFuzzer
from benchmarks.fuzz.frame import Fuzzer, fuzz
from benchmarks.fuzz.gxsm import GxsmFuzzer
from benchmarks.fuzz.nanonis import NanonisFuzzer
from benchmarks.fuzz.nanosurf import NanosurfFuzzer


def emulators() -> Iterator[tuple[type[Fuzzer[Any]], Emulator]]:
    """Each emulator, with what calls it."""
    yield NanonisFuzzer, NanonisEmulator()
    yield AsylumFuzzer, AsylumEmulator()
    yield NanosurfFuzzer, NanosurfEmulator()
    yield GxsmFuzzer, GxsmEmulator(version=3)
    yield GxsmFuzzer, GxsmEmulator(version=4, card="RPSPMC")
    if sys.platform.startswith("linux"):
        yield GxsmFuzzer, GxsmEmulator(version=4, transport="shm")


def main(count: int = 50_000, seed: int = 1) -> None:
    for fuzzer, emulator in emulators():
        with tempfile.TemporaryDirectory() as folder:
            outcome = fuzz(fuzzer, emulator, Path(folder), count, seed)
            print(json.dumps({"emulator": emulator.vendor, "calls": count, **asdict(outcome)}), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
