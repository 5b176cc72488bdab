"""The paper's method in the benchmark, with the paper's threshold and others."""

from __future__ import annotations

import pytest
from benchmarks.drift.inliers import ITERATIONS, MOST, THRESHOLD, THRESHOLDS, Matching, Pairing

pytest.importorskip("skimage")


def test_wide_threshold_counts_mismatches_as_inliers() -> None:
    found = Matching(Pairing(), "rough", 0, ("brief",)).run()
    by_threshold = [one for one in found if one.iterations == MOST]
    assert len(found) == len(THRESHOLDS) * len(ITERATIONS)
    inliers = [one.inliers for one in by_threshold]
    assert inliers == sorted(inliers)
    assert inliers[0] < inliers[-1]
    assert by_threshold[0].off_px < 1.0
    assert all(one.right * one.matches < one.inliers for one in by_threshold if one.threshold >= THRESHOLD)


def test_scans_with_another_resolution_have_fewer_matches() -> None:
    (half,), (same, *_) = (Matching(Pairing(sr_norm=sr), "rough", 0, ("brief",)).run() for sr in (0.5, 1.0))
    assert 0 < half.matches < same.matches
