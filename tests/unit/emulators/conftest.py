"""A clock that goes when a test says so, and an instrument on it."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import pytest

from afspm.emulators.rig import Rig


class FakeClock:
    def __init__(self, t_s: float = 1000.0) -> None:
        self.t_s = t_s

    def now_s(self) -> float:
        return self.t_s

    def now_ns(self) -> int:
        return int(self.t_s * 1e9)

    def monotonic_s(self) -> float:
        return self.t_s

    def real_s(self, experiment_s: float) -> float:
        return experiment_s

    def late(self) -> AbstractContextManager[None]:
        return nullcontext()


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def rig(clock: FakeClock) -> Rig:
    rig = Rig({}, seed=3, clock=clock, background=False)
    rig.setup.shape = (8, 16)
    rig.setup.line_s = 0.5
    return rig
