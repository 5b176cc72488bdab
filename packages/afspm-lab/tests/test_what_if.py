"""The scheduler of simulated nights with kills, replayed as it was and with decisions broken on purpose."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from recorded_night import RecordedNight, recorded
from rotation import ALL, rotated
from tests.simulation.test_mutants import MUTANTS

from afspm.model import Packet
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.step_log import Step
from afspm_lab.what_if import scheduler_replay
from afspm_lab.what_if.scheduler_replay import replay

pytestmark = pytest.mark.slow
PARTS = 6
"""Of the mutants: each replays a whole night."""
Patch = pytest.MonkeyPatch


@pytest.fixture(scope="module", params=(1, 2, 5) if ALL else (1,))
def night(request: pytest.FixtureRequest) -> RecordedNight:
    return recorded(request.param)


def test_unchanged_scheduler_gives_the_recorded_effects(night: RecordedNight) -> None:
    result = replay(night.kept)
    assert result.first is None
    assert result.first_step is None
    assert result.steps == len(night.states) > 500


def first_decided_otherwise(night: RecordedNight, patch: Patch) -> tuple[int | None, int | None]:
    """Return the first step with another state or other effects, and the step that the replay names."""
    truth: list[int] = []
    real, number = scheduler_replay._stepped, 0

    def stepped(core: SchedulerCore, one: Step) -> Any:
        nonlocal number
        effects = real(core, one)
        if not truth and (core.state != night.states[number] or effects != one.effects):
            truth.append(number + 1)
        number += 1
        return effects

    patch.setattr(scheduler_replay, "_stepped", stepped)
    result = replay(night.kept)
    # a state that differs and changes no effect is no decision that anything outside can know
    return (truth[0] if truth and result.first is not None else None), result.first_step if result.first else None


@pytest.mark.parametrize("part", rotated(range(PARTS), PARTS))
def test_mutants_are_found_at_the_step_where_they_first_decide_otherwise(night: RecordedNight, part: int) -> None:
    decided_otherwise, late = 0, []
    mutant: Callable[[Patch], None]
    for mutant in MUTANTS[part::PARTS]:
        with pytest.MonkeyPatch.context() as patch:
            mutant(patch)
            truth, found = first_decided_otherwise(night, patch)
        decided_otherwise += truth is not None
        late += [mutant.__name__] if truth is not None and truth != found else []
    assert decided_otherwise >= 1
    assert not late


def test_step_log_survives_its_file(tmp_path: Any) -> None:
    """What a scheduler writes, read back, gives the same effects: the decisions on the wire format, over a kill."""
    from afspm.components.planned_scans import ScanSeries
    from afspm.testing import Bench

    series = ScanSeries((1e-6, 1e-6), pixels=(8, 8), every=600.0, scans=3)
    bench = Bench(series, folder=tmp_path, keeps_requests=True)
    bench.at("12 min", bench.kill, "scheduler")
    bench.run(until="40 min")
    result = scheduler_replay.replay_file(tmp_path / "requests" / "scheduler.steps.jsonl")
    assert result.first is None
    assert result.steps > 50
    assert isinstance(bench.packets[0], Packet)
