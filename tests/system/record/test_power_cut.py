"""All processes of a recorded run are killed at once, and it is resumed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from afspm.testing.power_cut import power_cuts

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds processes in /proc")


def test_nothing_that_was_published_is_lost_and_nothing_is_there_twice(tmp_path: Path) -> None:
    verdict = power_cuts(tmp_path, cuts=4, seed=5)
    assert verdict.wrong == []
    assert verdict.seen > 0, "nobody saw anything"
    assert verdict.scans > 0
