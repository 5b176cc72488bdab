"""No request of an agent reaches the microscope outside of what a person has approved, whichever process dies."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from rotation import ALL

from tests.simulation.grant_attacks import attacked

SEEDS: Sequence[int] = range(40) if ALL else range(4)
CALLS = 2_500 if ALL else 300


@pytest.mark.parametrize("seed", SEEDS)
def test_adversarial_requests_stay_within_approvals(seed: int) -> None:
    attack = attacked(seed, CALLS, kills=0.02)
    # the attack was real: requests of the agent did arrive, and the scheduler did die
    assert attack.rig.watchman.checked > CALLS // 50
    assert attack.rig.kills_done
