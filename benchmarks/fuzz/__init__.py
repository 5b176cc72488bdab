"""Random calls of emulated controllers: nothing that a client sends may end one, or make it write anywhere else."""

from __future__ import annotations

from benchmarks.fuzz.frame import Fuzzer, Outcome, Unfit, fuzz

__all__ = ["Fuzzer", "Outcome", "Unfit", "fuzz"]
