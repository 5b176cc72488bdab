"""A frame that sticks out of the scanner: the output is clipped, so that the tip stays at the edge."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from afspm.model import Region
from afspm.simulation.instrument import SimulatedInstrument

QUIET = {"white_m": 0.0, "one_over_f_m": 0.0, "line_offset_m": 0.0, "scar_probability": 0.0}


def instrument(reach_m: tuple[float, float] | None) -> SimulatedInstrument:
    rig = SimulatedInstrument({"noise": QUIET}, seed=3, start_s=1000.0)
    rig.setup.shape, rig.setup.line_s, rig.setup.reach_m = (9, 17), 1.0, reach_m
    return rig


def heights(rig: SimulatedInstrument) -> np.ndarray:
    scan = rig.start_scan(1000.0)
    return np.asarray(scan.channels()["Height"][1])


@pytest.mark.parametrize("angle_deg", [0.0, 45.0])
def test_pixels_beyond_the_reach_show_the_surface_at_the_edge(angle_deg: float) -> None:
    rig, free = instrument((1e-6, 0.5e-6)), instrument(None)
    region = Region((0.0, 0.0), (2.5e-6, 0.8e-6), math.radians(angle_deg))
    for one in (rig, free):
        one.setup.region = region
    clipped, whole = heights(rig), heights(free)
    x, y = region.pixels_m(rig.setup.shape)
    inside = (np.abs(x) <= 1e-6) & (np.abs(y) <= 0.5e-6)
    assert 0.3 < inside.mean() < 0.9
    near_m = np.abs(clipped - whole)[inside].max()  # the feedback has another past at the edge
    assert near_m < 0.3e-9
    assert np.ptp(whole[~inside]) > np.ptp(clipped[~inside])
    if angle_deg == 0.0:
        row = clipped[4]
        assert np.ptp(row[x[4] < -1e-6]) < 0.3e-9
        assert np.ptp(row[x[4] > 1e-6]) < 0.3e-9


def test_tip_stays_within_the_reach_during_a_scan() -> None:
    rig = instrument((1e-6, 0.5e-6))
    rig.setup.region = Region((0.5e-6, 0.0), (2e-6, 2e-6))
    rig.start_scan(1000.0)
    assert rig.probe_at(1000.0) == pytest.approx((-0.5e-6, -0.5e-6))
    assert rig.probe_at(1000.5) == pytest.approx((1e-6, -0.5e-6))


def test_reach_of_a_running_scan_survives_a_kill() -> None:
    rig, again = instrument((1e-6, 0.5e-6)), instrument(None)
    rig.setup.region = again.setup.region = Region((0.0, 0.0), (2.5e-6, 2.5e-6))
    before = heights(rig)
    again.restore(json.loads(json.dumps(rig.state())))
    assert again.scan is not None
    assert np.array_equal(again.scan.channels()["Height"][1], before)
