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


def test_kills_find_a_way_back_that_forgets_the_bias(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_z, "_RESTORED", ())
    assert sum(night(seed).crashes for seed in SEEDS) > 0


def test_kills_find_a_state_that_is_not_saved_first(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = held_z.HeldZ.hold

    def hold(self: held_z.HeldZ) -> None:
        save, self._state.save = self._state.save, lambda: None  # type: ignore[method-assign]
        try:
            plain(self)
        finally:
            self._state.save = save  # type: ignore[method-assign]

    monkeypatch.setattr(held_z.HeldZ, "hold", hold)
    outcomes = [night(seed) for seed in range(60)]
    assert not all(one.is_as_before or one.is_withdrawn for one in outcomes)
