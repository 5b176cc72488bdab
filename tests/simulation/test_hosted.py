"""Real components, `Scope` and translator in simulation: every scan is taken once, wherever they are killed."""

from __future__ import annotations

import contextlib
import json
import logging
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from rotation import rotated

from afspm import wire
from afspm.basics.errors import ControlLost
from afspm.basics.exit_codes import ExitCode
from afspm.client.component import Component
from afspm.model import Problem, Region
from afspm.scheduler.settings import SchedulerSettings
from afspm.scheduler.wire_codec import WireCodec
from afspm.supervisor.supervision.child import ChildPolicy, RestartPolicy
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.testing.components.hosted_processes import ComponentProcess, TranslatorProcess
from afspm.testing.components.memory_network import Weather
from afspm.testing.components.scheduler_host import SchedulerHost
from afspm.testing.components.simulated_time import SimulatedTime
from tests.simulation.bench import CHANNELS, BenchMicroscope
from tests.simulation.keeper import Keeper

TILES = 6
SCAN_S = 60.0
TIP = int(Problem.TIP_SHAPE_CHANGED)


class Survey(Component):
    """Scans tile after tile, each once."""

    def run(self) -> None:
        for tile in range(self.memory.get("next", 0), TILES):
            scans = self.scope.scan(region_of(tile), shape=(4, 4), key=f"tile-{tile}")
            assert set(scans) == set(CHANNELS)
            assert scans.region.center_m == pytest.approx(region_of(tile).center_m, abs=1e-15)
            self.memory[f"tile-{tile}"] = [scan.filename for scan in scans.values()]
            self.memory["next"] = tile + 1
            self.memory.save()


class Worrier(Component):
    """Flags the tip from time to time."""

    period_s = 100.0

    def on_tick(self) -> None:
        self.scope.flag(TIP)


class Fixer(Component):
    """Repairs the tip whenever it is flagged."""

    def on_problem(self, problem: str, flagged: bool) -> None:
        if flagged and problem == "tip-shape-changed":
            self.fix()

    def fix(self) -> None:
        while TIP in self.scope.control_state.problems:
            with contextlib.suppress(ControlLost):
                with self.scope.control(solving=TIP):
                    self.scope.action("x-pulse")
                self.scope.clear(TIP)


def region_of(tile: int) -> Region:
    return Region((tile * 2e-6, 1e-6), (1e-6, 1e-6))


@dataclass
class Night:
    timeline: SimulatedTime
    scheduler: SchedulerHost
    survey: ComponentProcess
    translator: TranslatorProcess
    components: dict[str, ComponentProcess]
    finished: dict[int, tuple[float, float]]
    folder: Path
    keeper: Keeper

    def files(self) -> dict[str, list[str]]:
        memory = (self.folder / "survey.json").read_bytes() if (self.folder / "survey.json").exists() else b"{}"
        return {key: value for key, value in json.loads(memory).items() if key.startswith("tile-")}


def night(
    seed: int, folder: Path, *, dies_in_call: float = 0.0, dies_in_step: float = 0.0, worried: bool = True
) -> Night:
    timeline = SimulatedTime(seed, speed=10.0)
    weather = Weather(doubles=0.05)
    finished: dict[int, tuple[float, float]] = {}
    translator = TranslatorProcess(
        timeline, lambda: BenchMicroscope(SCAN_S, finished), folder, dies_in_call=dies_in_call / 4
    )
    settings = SchedulerSettings()
    observer = _Observer()
    scheduler = SchedulerHost(
        timeline,
        weather,
        settings,
        WireCodec(),
        wire,
        observer,
        dies_in_step=dies_in_step,
    )
    scheduler.translator = (translator, translator)
    cast: dict[str, type[Component]] = {"survey": Survey}
    if worried:
        cast |= {"worrier": Worrier, "fixer": Fixer}
    components = {
        name: ComponentProcess(timeline, weather, scheduler, name, made, folder, dies_in_call=dies_in_call)
        for name, made in cast.items()
    }
    policy = ChildPolicy(LivenessPolicy(beat_period_s=5.0), RestartPolicy(budget=10**6, longest_delay_s=2.0))
    keeper = Keeper(timeline, [translator, scheduler, *components.values()], policy)
    return Night(timeline, scheduler, components["survey"], translator, components, finished, folder, keeper)


class _Observer:
    """Checks that only solvers get control while a problem is flagged."""

    def carried_out(self, host: SchedulerHost, effect: object) -> None:
        """Accept every effect."""

    def stepped(self, host: SchedulerHost, event: object, effects: object) -> None:
        control = host.core.control
        assert control.holder is None or not control.problems or control.solving in control.problems


def run(night: Night, limit_s: float = 3000.0) -> None:
    while night.survey.ended_with != ExitCode.DONE and night.timeline.monotonic_s() < limit_s:
        night.timeline.run_until(night.timeline.monotonic_s() + 5.0)
    assert night.survey.ended_with == ExitCode.DONE, night.survey.ended_with


def check(night: Night) -> None:
    """Check that every requested scan was taken and published exactly once, with all its channels."""
    files = night.files()
    assert set(files) == {f"tile-{tile}" for tile in range(TILES)}
    names = [file for of_tile in files.values() for file in of_tile]
    assert Counter(names) == Counter({name: len(CHANNELS) for name in names})
    taken = Counter(round(x / 1e-7) for x, _ in night.finished.values())
    wanted = Counter(round((region_of(tile).top_left_m[0]) / 1e-7) for tile in range(TILES))
    assert taken == wanted


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logger = logging.getLogger("afspm")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    yield
    logger.setLevel(before)  # else whoever is tested after us in this process says nothing


def test_a_quiet_survey_is_complete(tmp_path: Path) -> None:
    quiet = night(1, tmp_path, worried=False)
    run(quiet)
    check(quiet)


def test_schedule_of_faults_replays_exactly(tmp_path: Path) -> None:
    ends = []
    for attempt in ("a", "b"):
        made = night(5, tmp_path / attempt, dies_in_call=0.01)
        run(made)
        ends.append((made.timeline.monotonic_s(), made.timeline.happened, made.files()))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("seed", rotated(range(16), 4))
def test_every_scan_is_taken_once_although_control_is_lost_and_all_processes_killed(seed: int, tmp_path: Path) -> None:
    made = night(seed, tmp_path, dies_in_call=0.02, dies_in_step=0.01)
    run(made)
    check(made)


@pytest.mark.parametrize("seed", rotated(range(12), 3))
def test_every_scan_is_taken_once_although_components_are_killed_anywhere(seed: int, tmp_path: Path) -> None:
    made = night(seed, tmp_path, dies_in_call=0.02, worried=False)
    run(made)
    check(made)


@pytest.mark.parametrize("seed", rotated(range(12), 3))
def test_every_scan_is_taken_once_although_the_scheduler_is_killed_anywhere(seed: int, tmp_path: Path) -> None:
    made = night(seed, tmp_path, dies_in_step=0.02, worried=False)
    run(made)
    check(made)
