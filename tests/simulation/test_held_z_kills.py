"""A translator that is killed at any step of a held z: the tip never touches the sample."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from afspm.translator import held_z
from afspm.translator.parameters import FEEDBACK_ON, Value
from tests.simulation.held_z_kills import Controller, HeldZNight, Killed, night

SEEDS = range(10)


@pytest.mark.parametrize("seed", SEEDS)
def test_tip_is_never_crashed_by_a_kill_in_a_hold(seed: int) -> None:
    outcome = night(seed)
    assert outcome.crashes == 0
    assert outcome.is_as_before or outcome.is_withdrawn


def test_way_back_that_forgets_the_bias_crashes_the_tip(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_z, "_RESTORED", ())
    assert any(night(seed, kill_at=10**9).crashes for seed in SEEDS)


# tip T9
def test_kill_right_after_the_feedback_went_off_finds_the_way_back_on_disk(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    switch = Controller.set

    def killed(controller: Controller, values: Mapping[str, Value]) -> None:
        switch(controller, values)
        if values.get(FEEDBACK_ON) is False:
            raise Killed

    monkeypatch.setattr(Controller, "set", killed)
    hold = HeldZNight(0, tmp_path, kill_at=10**9)
    outcome = hold.run()
    hold.close()
    assert (outcome.kills, outcome.is_as_before) == (1, True)
