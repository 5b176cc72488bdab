"""The default tracker with the default estimator, on simulated images."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.drift.nights import FRAME_S, INTERVAL_S, Night, Oracle

from afspm.plugins.drift.estimators import unguarded
from afspm.plugins.drift.track import tracker

NM = 1e-9


def test_scans_are_followed_to_a_tenth_of_a_pixel_after_a_first_jump_cut_by_an_up_and_a_down_frame() -> None:
    night = Night("rough", 502, 4)
    misplaced, mistaken = [], []
    for drift_m, update in night.followed(tracker({"compared": 1}, unguarded()), up_and_down=True):
        assert update.matched
        misplaced.append(np.linalg.norm(-update.before.mapping.translation_m - drift_m))
        mistaken.append(np.linalg.norm(-update.after.mapping.translation_m - drift_m))
    moved_m = night.drift.at(np.array(INTERVAL_S + FRAME_S / 2)) - night.drift.at(np.array(FRAME_S / 2))
    assert np.linalg.norm(moved_m) > 200 * NM
    assert max(misplaced) < 30 * NM
    assert max(mistaken) < 1.5 * NM


def test_the_oracle_knows_the_truth() -> None:
    """Otherwise all comparisons with it would be meaningless."""
    night = Night("rough", 2, 12)
    for number, (drift_m, update) in enumerate(night.followed(tracker("bank", Oracle(night.drift)))):
        # The rows that both scans of the first pair show were taken at other times, and the rate is unknown yet.
        tolerated_m = 1.0 * NM if number < 4 else 0.05 * NM
        assert -update.after.mapping.translation_m - drift_m == pytest.approx(np.zeros(2), abs=tolerated_m)
