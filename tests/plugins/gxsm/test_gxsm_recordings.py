"""Recordings of GXSM, replayed to the driver in this process with their own clock."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.plugins.gxsm.recorded_gxsm import LOOK_S, looked_at, played, publishes_no_stopped_scan, scanned_one_by_one
from tests.plugins.gxsm.written_trace import SHAPE, repeated_and_stopped, two_scans

from afspm.model import ScopeState, names


def test_a_scan_stopped_while_the_panel_repeats_is_not_published(tmp_path: Path) -> None:
    """The scan before it is lost, as Auto Save was off."""
    publishes_no_stopped_scan(repeated_and_stopped(), tmp_path)


def test_repeated_scans_are_separated_by_their_lines_alone(tmp_path: Path) -> None:
    # The worst case: no poll falls between two scans, and the file name stays the same.
    scan_s, rows = 0.66, SHAPE[0]

    def line(at_s: float) -> int:
        last = rows - 1 if at_s < 4.71 else rows // 2
        return rows - 1 if at_s < 4.05 else min(int((at_s - 4.05) % scan_s / scan_s * rows), last)

    def bits(at_s: float) -> list[float]:
        return [3.0 if 4.03 <= at_s < 5.01 else 1.0, 0.0, 0.0]

    def name(_: float) -> str:
        return "./scan007-M-Xp-ZSmTopo.nc"

    made_up = {"y_current": line, "rtquery": bits, "chfname 0": name}
    driver, link, clock = played(repeated_and_stopped(), tmp_path, **made_up)
    states, scans = looked_at(driver, link, clock, 13.0)
    assert not scans
    assert states.count(ScopeState.INTERRUPTED) == 2


UNSAVED = {
    SHAPE[0]: "it came to its end, but the next one began and GXSM had saved no file: Movie or Multi Layer?",
    SHAPE[0] // 2: "another one began before it was saved: it was stopped, or GXSM saved no file of it",
}
"""Reasons by the rows of each scan."""


@pytest.mark.parametrize("rows", UNSAVED)
def test_frame_of_a_movie_is_distinguished_from_a_stopped_scan(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, rows: int
) -> None:
    # Scans without files follow each other; each line takes two looks.
    line_s = 2 * LOOK_S
    scan_s = rows * line_s

    def line(at_s: float) -> int:
        return SHAPE[0] - 1 if at_s < 4.05 else int((at_s - 4.05) % scan_s / line_s)

    made_up = {
        "y_current": line,
        "rtquery": lambda at_s: [3.0 if at_s >= 4.03 else 1.0, 0.0, 0.0],
        "chfname 0": lambda _: "./scan007-M-Xp-ZSmTopo.nc",
    }
    driver, link, clock = played(repeated_and_stopped(), tmp_path, **made_up)
    _, scans = looked_at(driver, link, clock, 4.05 + 10 * scan_s)
    assert not scans
    found = [why for why in UNSAVED.values() if f"the scan has no result: {why}" in caplog.text]
    assert found == [UNSAVED[rows]]


@pytest.mark.parametrize(
    ("version", "channels"),
    [(4, {"ZS-Topo"}), (3, {"Topo", "Topo Backward", "ADC1"})],
)
def test_scans_are_published_with_their_channels(tmp_path: Path, version: int, channels: set[str]) -> None:
    driver, found = scanned_one_by_one(two_scans(version, len(channels)), tmp_path, 8.0)
    assert len(found) == 2
    for states, scans in found:
        assert states == [ScopeState.SCANNING, ScopeState.FREE]
        assert {scan.channel for scan in scans} == channels
    assert names.START_SCAN in driver.own_actions()
