"""Nights with a coarse motor: no move strikes the tip, and each part of the interlock is needed for that."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulation.mover_nights import night

LASTS_S = 200.0


@pytest.mark.parametrize("seed", [1, 3])
def test_no_move_strikes_the_tip(seed: int, tmp_path: Path) -> None:
    found = night(seed, tmp_path, lasts_s=LASTS_S)
    assert (found.struck, found.crashes, found.in_air) == (0, 0, 0)
    assert found.moves > 20
    assert found.scans > 2


def test_interlock_without_a_retraction_strikes_the_tip(tmp_path: Path) -> None:
    assert night(3, tmp_path, "retraction", LASTS_S).struck


def test_interlock_without_a_proof_measures_in_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("afspm.scheduler.safety.movers.MEASURES", frozenset())
    assert night(3, tmp_path, lasts_s=LASTS_S).in_air
