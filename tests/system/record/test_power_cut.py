"""A recorded run loses its power, and is resumed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from tests.system.record.power_cut import power_cuts

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="finds processes in /proc")


@pytest.mark.parametrize("lossy", [True, False], ids=["what was not synced is lost", "all processes are killed"])
def test_power_cut_loses_and_duplicates_no_publication(tmp_path: Path, *, lossy: bool) -> None:
    verdict = power_cuts(tmp_path, cuts=3, seed=5, lossy=lossy)
    assert verdict.wrong == []
    assert verdict.seen > 0, "nobody saw anything"
    assert verdict.scans > 0
