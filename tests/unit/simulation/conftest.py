"""A clock set by the test, and an instrument on it."""

from __future__ import annotations

import pytest
from fake_clock import FakeClock

from afspm.simulation.instrument import SimulatedInstrument


@pytest.fixture
def clock() -> FakeClock:
    return FakeClock()


@pytest.fixture
def rig(clock: FakeClock) -> SimulatedInstrument:
    rig = SimulatedInstrument({}, seed=3, start_s=clock.t_s)
    rig.setup.shape = (8, 16)
    rig.setup.line_s = 0.5
    return rig
