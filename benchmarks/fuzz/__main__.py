"""`python -m benchmarks.fuzz [COUNT [SEED]]`: random calls (default: 50,000) of every vendor's emulator."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from afspm.simulation.emulation.emulator import Emulator, emulator_names
from benchmarks.fuzz.frame import Fuzzer, fuzz


def emulators() -> Iterator[tuple[type[Fuzzer[Any]], Emulator]]:
    """Yield each emulator with its fuzzer, from the modules of this folder with the name of an emulator."""
    for name in emulator_names():
        if find_spec(f"benchmarks.fuzz.{name}") is not None:
            yield from import_module(f"benchmarks.fuzz.{name}").cases()


def main(count: int = 50_000, seed: int = 1) -> None:
    for fuzzer, emulator in emulators():
        with tempfile.TemporaryDirectory() as folder:
            outcome = fuzz(fuzzer, emulator, Path(folder), count, seed)
            print(json.dumps({"emulator": emulator.vendor, "calls": count, **asdict(outcome)}), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
