"""A microscope whose scans never match the request ends in a flag, not in endless scans."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from client_lab import OTHER_REGION, Lab, run

from afspm.basics.errors import MeasurementFailed
from afspm.basics.exit_codes import ExitCode
from afspm.components.planned_scans import ScanSeries
from afspm.model import Problem, Region, Scan

SIZE = (1e-6, 1e-6)
FAR_AWAY = Region((1.0, 1.0), SIZE)


class FailingLab(Lab):
    """Publishes for every scan the result of `measured` for its region."""

    def __init__(self, measured: Callable[[Region], tuple[Region, tuple[int, int]] | None]) -> None:
        super().__init__("series")
        self.measured = measured

    def publish_scan(self, region: Region, shape: tuple[int, int] = (8, 8)) -> None:
        found = self.measured(region)
        if found is not None:
            where, pixels = found
            self.publish(Scan(where, "Height", "m", np.zeros(pixels), self.clock.now_ns()))


def series() -> ScanSeries:
    return ScanSeries(SIZE, pixels=(8, 8), scans=3)


@pytest.mark.parametrize(
    "measured",
    [
        lambda region: (region, (1, 1)),
        lambda region: (region, (1, 8)),
        lambda region: None,
        lambda region: (FAR_AWAY, (8, 8)),
        lambda region: (OTHER_REGION, (8, 8)),
    ],
    ids=["one pixel", "one row", "none", "far away", "elsewhere"],
)
def test_scans_that_differ_from_the_request_end_in_a_flag_with_a_reason(
    measured: Callable[[Region], tuple[Region, tuple[int, int]] | None],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    lab = FailingLab(measured)
    with pytest.raises(MeasurementFailed):
        run(series(), lab, tmp_path)
    assert lab.control.published().problems == (Problem.DEVICE_MALFUNCTION,)
    assert "the scan failed 5 times: " in caplog.text
    assert lab.begun_scans == 5

    again = FailingLab(measured)  # the supervisor starts it again
    again.flag(Problem.DEVICE_MALFUNCTION)
    again.at(10_000.0, again.kill)
    assert run(series(), again, tmp_path) == ExitCode.ENDED
    assert again.begun_scans == 0
