"""A clock that goes when a test says so, and an instrument on it."""

from __future__ import annotations

import pytest
from fake_clock import FakeClock

from afspm.emulators.rig import Rig


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def rig(clock: FakeClock) -> Rig:
    rig = Rig({}, seed=3, clock=clock, background=False)
    rig.setup.shape = (8, 16)
    rig.setup.line_s = 0.5
    return rig
