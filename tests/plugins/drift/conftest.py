"""Makes the repository's `benchmarks` importable: its generator of pairs serves the tests, too."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))
# the laboratory in memory that the client is tested with
sys.path.insert(0, str(Path(__file__).parents[2] / "unit" / "client"))


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw coarsely, where the look of a figure is not tested."""
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("afspm.plugins.drift.report.style.DPI", 30)
    monkeypatch.setattr("afspm.plugins.drift.report.style.LAYOUT", None)
