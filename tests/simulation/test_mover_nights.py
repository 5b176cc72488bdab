"""Nights with a coarse motor: no move strikes the tip, and each part of the interlock is needed for that."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.translator.commands import Commands
from tests.simulation.mover_nights import Mutant, night

LASTS_S = 200.0


@pytest.mark.parametrize("seed", [1, 3])
def test_no_move_strikes_the_tip(seed: int, tmp_path: Path) -> None:
    found = night(seed, tmp_path, lasts_s=LASTS_S)
    assert (found.struck, found.crashes, found.in_air) == (0, 0, 0)
    assert found.moves > 20
    assert found.scans > 2


@pytest.mark.parametrize("mutant", ["tip", "retraction"])
def test_interlock_without_a_part_strikes_the_tip(
    mutant: Mutant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if mutant == "tip":  # the translator reads the tip, too
        monkeypatch.setattr(Commands, "_refuse_at_sample", lambda self: None)
    assert night(3, tmp_path, mutant, LASTS_S).struck


def test_interlock_without_a_proof_measures_in_air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("afspm.scheduler.safety.movers.MEASURES", frozenset())
    assert night(3, tmp_path, lasts_s=LASTS_S).in_air
