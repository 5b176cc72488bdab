"""Lines of a running scan, in the coordinates of components."""

from __future__ import annotations

import numpy as np
from tests.plugins.drift.drift_lab import Lab, forecast

from afspm.model import ControlRequest, Region, ScanLines, ScanParameters

DRIFT = (100e-9, -50e-9)
THERE = Region((1e-6, 2e-6), (1e-6, 0.5e-6), 0.5)


def lines_at(region: Region) -> ScanLines:
    return ScanLines(region, (8, 4), "Height", "m", 2, np.arange(12.0).reshape(3, 4), began_ns=5)


def test_lines_lie_at_the_requested_region() -> None:
    lab = Lab()
    lab.in_force()
    lab.take_control()
    lab.knows(forecast(DRIFT))
    lab.ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(THERE, (8, 4)))
    lab.answer(lab.sent())
    tip = THERE.moved_to((THERE.center_m[0] + DRIFT[0], THERE.center_m[1] + DRIFT[1]))
    lab.publish(lines_at(tip))
    (told,) = lab.published("ScanLines")
    assert told.region == THERE
    np.testing.assert_array_equal(told.values, lines_at(tip).values)
    assert (told.first_row, told.shape, told.began_ns) == (2, (8, 4), 5)


def test_lines_of_an_unrequested_scan_lie_at_its_place_on_the_sample() -> None:
    lab = Lab()
    lab.in_force()
    lab.knows(forecast(DRIFT))
    lab.publish(lines_at(THERE))
    (told,) = lab.published("ScanLines")
    np.testing.assert_allclose(told.region.center_m, np.subtract(THERE.center_m, DRIFT), atol=1e-15)


def test_lines_pass_unchanged_while_no_drift_is_known() -> None:
    lab = Lab()
    lab.in_force()
    lab.publish(lines_at(THERE))
    (told,) = lab.published("ScanLines")
    assert told.region == THERE
