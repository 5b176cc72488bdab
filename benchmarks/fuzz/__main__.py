"""`python -m benchmarks.fuzz [COUNT [SEED]]`: random calls (default: 50,000) of every vendor's emulator."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

from afspm.emulators.asylum import AsylumEmulator
from afspm.emulators.emulator import Emulator
from afspm.emulators.nanonis import NanonisEmulator
from benchmarks.fuzz.asylum import AsylumFuzzer
from benchmarks.fuzz.frame import Fuzzer, fuzz
from benchmarks.fuzz.nanonis import NanonisFuzzer

FUZZERS: dict[type[Fuzzer[Any]], type[Emulator]] = {NanonisFuzzer: NanonisEmulator, AsylumFuzzer: AsylumEmulator}


def main(count: int = 50_000, seed: int = 1) -> None:
    for fuzzer, emulator in FUZZERS.items():
        with tempfile.TemporaryDirectory() as folder:
            outcome = fuzz(fuzzer, emulator(port=0), Path(folder), count, seed)
            print(json.dumps({"emulator": emulator.vendor, "calls": count, **asdict(outcome)}), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
