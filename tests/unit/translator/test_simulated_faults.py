"""Faults of the simulated microscope, without a process."""

from __future__ import annotations

import copy
import logging
from pathlib import Path
from typing import Any

import pytest

from afspm.basics.errors import Refused
from afspm.model import ScopeState
from afspm.simulation.scan_drawing import run_at_once
from afspm.simulation.simulator import Simulator
from afspm.translator.driver_base import ControllerLost

FREE, SCANNING, COARSE = ScopeState.FREE, ScopeState.SCANNING, ScopeState.COARSE_MOTOR


@pytest.fixture
def scope(request: Any, tmp_path: Path, fake_clock: Any) -> Simulator:
    """A microscope with one fault, whose scans take 4 s."""
    initial: dict[str, object] = {"scan-resolution-x": 8, "scan-resolution-y": 4}
    made = Simulator(faults=[request.param], initial=initial)
    made.run_drawing = run_at_once  # type: ignore[method-assign]
    made.clock, made.log, made.run_dir = fake_clock, logging.getLogger("test"), tmp_path
    made.memory, made.wake = {}, lambda: None
    made.connect()
    return made


def restarted(scope: Simulator, memory: Any) -> Simulator:
    """The microscope after a restart with this saved state, without faults."""
    made = Simulator()
    made.run_drawing = run_at_once  # type: ignore[method-assign]
    made.clock, made.log, made.run_dir = scope.clock, scope.log, scope.run_dir
    made.memory, made.wake = memory, lambda: None
    made.connect()
    return made


def scanned(scope: Simulator, fake_clock: Any) -> ScopeState:
    """The state after the time of a scan."""
    scope.start_scan()
    fake_clock.t_s += 5.0
    return scope.status().state


@pytest.mark.parametrize("scope", [{"kind": "scan-refused"}], indirect=True)
def test_scan_does_not_begin_without_an_error(scope: Simulator, fake_clock: Any) -> None:
    scope.start_scan()
    assert scope.status().state is FREE
    assert scanned(scope, fake_clock) is FREE
    assert len(scope.results()) == 1, "the next one does"


@pytest.mark.parametrize(
    ("scope", "state"), [({"kind": "stopped"}, FREE), ({"kind": "withdrawn"}, COARSE)], indirect=["scope"]
)
def test_scan_is_ended_at_the_panel(scope: Simulator, state: ScopeState, fake_clock: Any) -> None:
    scope.start_scan()
    assert scope.status().state is state
    fake_clock.t_s += 100.0
    assert scope.status().state is FREE
    assert scope.results() == []


@pytest.mark.parametrize("scope", [{"kind": "no-file"}], indirect=True)
def test_scan_is_not_saved(scope: Simulator, fake_clock: Any, tmp_path: Path) -> None:
    assert scanned(scope, fake_clock) is FREE
    assert (scope.results(), list(tmp_path.rglob("*.nc"))) == ([], [])


@pytest.mark.parametrize("scope", [{"kind": "late-file", "duration_s": 60.0}], indirect=True)
def test_file_appears_late(scope: Simulator, fake_clock: Any) -> None:
    assert scanned(scope, fake_clock) is FREE
    (result,) = scope.results()
    assert not Path(result).exists()
    assert scope.next_event_s() == 1064.0
    assert scope.next_change_s() is None  # a controller does not announce that its file is late
    fake_clock.t_s += 60.0
    assert scope.status().state is FREE
    assert Path(result).exists()


@pytest.mark.parametrize("scope", [{"kind": "late-file", "count": 2, "duration_s": 60.0}], indirect=True)
def test_each_of_several_late_files_appears(scope: Simulator, fake_clock: Any) -> None:
    for _ in range(2):
        assert scanned(scope, fake_clock) is FREE
    results = [Path(result) for result in scope.results()]
    assert [result.exists() for result in results] == [False, False]
    fake_clock.t_s += 60.0
    assert scope.status().state is FREE
    assert [result.exists() for result in results] == [True, True]


@pytest.mark.parametrize("scope", [{"kind": "restart", "at_s": 2.0, "duration_s": 10.0}], indirect=True)
def test_controller_is_lost_for_a_while_and_its_scan_goes_on(scope: Simulator, fake_clock: Any) -> None:
    scope.start_scan()
    fake_clock.t_s += 3.0
    for ask in (scope.status, scope.connect, scope.results, scope.stop_scan, lambda: scope.get("scan-speed")):
        with pytest.raises(ControllerLost):
            ask()
    fake_clock.t_s += 10.0
    scope.connect()
    assert scope.status().state is FREE
    assert len(scope.results()) == 1


@pytest.mark.parametrize("scope", [{"kind": "error", "count": 2}], indirect=True)
def test_requests_are_refused_but_withdrawing_is_not(scope: Simulator) -> None:
    with pytest.raises(Refused, match="simulated fault"):
        scope.start_scan()
    scope.retract()
    with pytest.raises(Refused, match="simulated fault"):
        scope.set({"scan-speed": 1e-6})
    scope.set({"scan-speed": 1e-6})


@pytest.mark.parametrize("scope", [{"kind": "no-file", "at_s": 1e6}], indirect=True)
def test_file_stays_when_a_power_cut_takes_the_state_back_to_before_it(
    scope: Simulator, fake_clock: Any, tmp_path: Path
) -> None:
    before = copy.deepcopy(scope.memory)
    assert scanned(scope, fake_clock) is FREE
    (first,) = scope.results()
    content = Path(first).read_bytes()
    again = restarted(scope, before)
    assert scanned(again, fake_clock) is FREE
    assert Path(first).read_bytes() == content
    assert sorted(path.name for path in tmp_path.rglob("*.nc")) == ["scan-0001.nc", "scan-0002.nc"]
