"""Random calls of emulated controllers: no call may end one, or make it write outside its folder."""

from __future__ import annotations

from benchmarks.fuzz.frame import Fuzzer, Outcome, Unfit, fuzz

__all__ = ["Fuzzer", "Outcome", "Unfit", "fuzz"]
