"""The rules for rescans."""

from __future__ import annotations

import math

import pytest

from afspm.basics import InvalidValue
from afspm.model import Frame, Region
from afspm.plugins.drift.pairs.overlap import too_far_off, too_little_shared

NM = 1e-9
ASKED = Region((0.0, 0.0), (2e-6, 2e-6), frame=Frame.SAMPLE)


@pytest.mark.parametrize(("off", "again"), [(0.0, False), (0.24, False), (0.26, True), (1.5, True)])
def test_the_paper_s_rule_compares_the_shared_area(off: float, *, again: bool) -> None:
    scanned = ASKED.moved_to((off * 2e-6, 0.0))
    assert bool(too_little_shared(ASKED, scanned, 0.75)) == again


def test_the_paper_s_rule_counts_the_smaller_region() -> None:
    inside = Region((0.5e-6, 0.0), (1e-6, 1e-6), frame=Frame.SAMPLE)
    assert too_little_shared(ASKED, inside, 1.0) == ""


@pytest.mark.parametrize(
    ("off_nm", "sd_nm", "again"),
    [(0.0, 0.0, False), (8.0, 0.9, False), (8.0, 1.1, True), (10.1, 0.0, True), (0.0, 5.1, True)],
)
def test_the_tolerance_counts_the_uncertainty(off_nm: float, sd_nm: float, *, again: bool) -> None:
    scanned = ASKED.moved_to((0.6 * off_nm * NM, 0.8 * off_nm * NM))
    assert bool(too_far_off(ASKED, scanned, sd_nm * NM, 10.0 * NM)) == again


def test_a_rotated_scan_is_off_at_its_corners() -> None:
    turned = Region((0.0, 0.0), (2e-6, 2e-6), 0.01, Frame.SAMPLE)
    corner_m = 0.01 * math.sqrt(2) * 1e-6
    assert too_far_off(ASKED, turned, 0.0, 1.01 * corner_m) == ""
    assert "14.1 nm off" in too_far_off(ASKED, turned, 0.0, 0.99 * corner_m)


def test_the_reason_for_a_rescan_names_the_value_that_exceeds_the_tolerance() -> None:
    scanned = ASKED.moved_to((8.0 * NM, 0.0))
    assert too_far_off(ASKED, scanned, 1.5 * NM, 10.0 * NM) == (
        "it may be 11 nm off (8 nm, and twice the standard deviation of 1.5 nm), 10 nm is tolerated"
    )


def test_regions_in_tip_coordinates_are_refused() -> None:
    tip = Region((0.0, 0.0), (2e-6, 2e-6))
    with pytest.raises(InvalidValue, match="tip coordinates"):
        too_little_shared(ASKED, tip)
    with pytest.raises(InvalidValue, match="tip coordinates"):
        too_far_off(tip, ASKED, 0.0, 1e-9)


@pytest.mark.parametrize("tolerance_m", [0.0, -1e-9, math.nan])
def test_a_meaningless_tolerance_is_refused(tolerance_m: float) -> None:
    with pytest.raises(InvalidValue, match="tolerance"):
        too_far_off(ASKED, ASKED, 0.0, tolerance_m)
