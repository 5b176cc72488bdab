"""A translator that is killed at any step of a held z: the tip never touches the sample."""

from __future__ import annotations

import pytest

from afspm.translator import held_z
from tests.simulation.held_z_kills import night

SEEDS = range(10)


@pytest.mark.parametrize("seed", SEEDS)
def test_tip_is_never_crashed_by_a_kill_in_a_hold(seed: int) -> None:
    outcome = night(seed)
    assert outcome.crashes == 0
    assert outcome.is_as_before or outcome.is_withdrawn


def test_way_back_that_forgets_the_bias_crashes_the_tip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_z, "_RESTORED", ())
    assert any(night(seed, kill_at=10**9).crashes for seed in SEEDS)
