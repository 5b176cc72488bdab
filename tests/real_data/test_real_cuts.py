"""The drift benchmark's pairs that are cut out of images of real microscopes."""

from __future__ import annotations

import pytest
from tests.plugins.drift.quiet_pairs import require_match_at_truth


def test_pair_cut_from_a_real_image_matches_itself_at_its_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    require_match_at_truth(monkeypatch)
