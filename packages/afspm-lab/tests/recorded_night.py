"""The steps of a simulated scheduler, in memory, as `[record] requests = true` keeps them on disk."""

from __future__ import annotations

from typing import NamedTuple

from tests.simulation.night import Night, _settings, bad_night

from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.state import SchedulerState
from afspm.scheduler.step_log import RecordedCore, Restored, Step
from afspm_lab.what_if.scheduler_replay import MakeCore


class RecordedNight(NamedTuple):
    """A night's steps, and the scheduler's state after each."""

    kept: list[tuple[MakeCore, Restored] | Step]
    states: list[SchedulerState]


def recorded(seed: int) -> RecordedNight:
    """Run a night with many faults, and return its steps."""
    night = Night(bad_night(seed))
    settings, cores = _settings(night.plan), list[RecordedCore]()
    made = RecordedNight([], [])

    def keep(one: Restored | Step) -> None:
        if isinstance(one, Step):
            made.kept.append(one)
            made.states.append(cores[-1].state)
        else:
            made.kept.append((lambda: SchedulerCore(settings, night.codec), one))

    def make() -> RecordedCore:
        cores.append(RecordedCore(settings, night.codec, keep=keep))
        return cores[-1]

    night.scheduler._make_core = make
    night.run()
    return made
