"""The component `Sweep` in the laboratory in memory: its settings, its kills and its refusals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from client_lab import Kill9, Lab, LabPort, context_of, run

from afspm.basics.errors import ConfigError
from afspm.basics.exit_codes import ExitCode
from afspm.components.sweep import Sweep
from afspm.experiment.planned_measurements import plan_of, refusals
from afspm.scheduler.safety.limits import ExperimentLimits, Limit
from afspm.storage.memory import Memory

BIAS = {"tip-bias-voltage": ["0.1 V", "0.2 V", "0.3 V"]}


def sweep(parameters: dict[str, Any] = BIAS, **given: Any) -> Sweep:
    return Sweep(parameters, end_when_done=True, **given)


def test_sweep_measures_each_point_sets_back_and_ends_the_experiment() -> None:
    lab = Lab("sweep")
    assert run(sweep(), lab) == ExitCode.ENDED
    assert lab.begun_scans == 3
    assert lab.values["tip-bias-voltage"] == "0.5"


def life(lab: Lab, folder: Path, session: str, component: Sweep, deadly_call: int = 0) -> int:
    context = context_of(lab, folder)
    context.session = session
    context.open_port = lambda: LabPort(lab, deadly_call)
    return component.run_process(context)


def test_killed_sweep_measures_only_the_remaining_points(tmp_path: Path) -> None:
    for deadly_call in range(5, 40, 3):
        lab, folder = Lab("sweep"), tmp_path / str(deadly_call)
        with pytest.raises(Kill9):
            life(lab, folder, "0", sweep(), deadly_call)
        lab.restart_component()
        assert life(lab, folder, "1", sweep()) == ExitCode.ENDED
        assert lab.begun_scans == 3, deadly_call
        assert lab.values["tip-bias-voltage"] == "0.5", deadly_call
        assert not list((folder / "sweep.results").glob("*")), "what is kept of each point is removed"


def test_loop_with_a_grid_at_each_point_goes_on_after_a_kill(tmp_path: Path) -> None:
    loop = {"tip-bias-voltage": ["0.1 V", "0.2 V", "0.1 V"]}
    grid = {"counts": (2, 1), "spacing": (1e-8, 1e-8)}
    regions = [{"center": (0.0, 0.0), "size": (1e-6, 1e-6)}]

    def component() -> Sweep:
        return sweep(loop, order="listed", measure="both", regions=regions, grid=grid, pixels=(8, 8))

    for deadly_call in range(5, 80, 15):
        lab, folder = Lab("sweep"), tmp_path / str(deadly_call)
        with pytest.raises(Kill9):
            life(lab, folder, "0", component(), deadly_call)
        lab.restart_component()
        assert life(lab, folder, "1", component()) == ExitCode.ENDED
        assert lab.begun_scans == 9, deadly_call  # a scan and two spectra at each of three points
    work = component().planned_work(1e-6)
    assert work is not None
    assert (work.scans, work.spectra) == (3, 6)


def test_plan_saved_before_points_could_repeat_is_gone_on_with(tmp_path: Path) -> None:
    lab = Lab("sweep")
    with pytest.raises(Kill9):
        life(lab, tmp_path, "0", sweep(), 35)
    saved = Memory(tmp_path / "sweep.json")
    assert saved["sweep"].keys() == {"axes", "order", "seed", "measure"}


def test_sweep_refuses_other_values_than_it_was_begun_with(tmp_path: Path) -> None:
    lab = Lab("sweep")
    with pytest.raises(Kill9):
        life(lab, tmp_path, "0", sweep(), 35)
    lab.restart_component()
    begun = lab.begun_scans
    with pytest.raises(ConfigError, match="begun with other values"):
        life(lab, tmp_path, "1", sweep({"tip-bias-voltage": ["0.1 V", "0.4 V"]}))
    assert lab.begun_scans == begun


@pytest.mark.parametrize(
    ("given", "where"),
    [
        ({"kind": "IV"}, "kind"),
        ({"at": (0.0, 0.0)}, "at"),
        ({"measure": "spectrum", "size": (1e-6, 1e-6)}, "size"),
        ({"center": (0.0, 0.0)}, "center"),
        ({"measure": "spectrum", "regions": [{"size": (1e-6, 1e-6)}]}, "regions"),
        ({"grid": {"counts": (2, 2), "spacing": (1e-8, 1e-8)}}, "grid"),
        ({"measure": "both", "at": (0.0, 0.0), "positions": [(0.0, 0.0)]}, "positions"),
        ({"regions": [{"size": (1e-6, 1e-6)}], "size": (1e-6, 1e-6)}, "size"),
        ({"measure": "spectrum", "positions": []}, "positions"),
        ({"withdraw": True}, "withdraw"),
        ({"repeat": 0}, "repeat"),
        ({"parameters": {"tip-bias-voltage": [1.0, 2.0, 1.0]}}, "parameters.tip-bias-voltage"),
        ({"parameters": {}}, "parameters"),
        ({"parameters": {"tip-bias-voltage": ["1 nm"]}}, "parameters.tip-bias-voltage"),
        ({"parameters": {"scan-size-x": ["1 nm"]}, "size": (1e-6, 1e-6)}, "parameters.scan-size-x"),
        ({"parameters": {"scan-resolution-x": [64]}, "pixels": (8, 8)}, "parameters.scan-resolution-x"),
    ],
)
def test_settings_that_make_no_sense_are_refused_with_their_place(given: dict[str, Any], where: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Sweep(**({"parameters": BIAS} | given))
    assert caught.value.where == where


def test_check_finds_swept_values_outside_the_limits() -> None:
    plan = plan_of(Sweep, {"parameters": {"tip-bias-voltage": {"from": 0.1, "to": 3.0, "points": 30}}})
    assert plan is not None
    limits = ExperimentLimits(parameters={"tip-bias-voltage": Limit(high=2.5, unit="V")})
    found = refusals("sweep", plan, limits)
    assert found
    assert {one.where for one in found} == {("parameters", "tip-bias-voltage")}


@pytest.mark.parametrize(("order", "is_fine"), [("snake", True), ("listed", False)])
def test_check_finds_steps_between_points_that_a_limit_refuses(order: str, is_fine: bool) -> None:
    swept = {"zctrl-igain": [1, 2], "tip-bias-voltage": ["-0.4 V", "0.0 V", "0.4 V"]}
    plan = plan_of(Sweep, {"parameters": swept, "order": order})
    assert plan is not None
    limits = ExperimentLimits(parameters={"tip-bias-voltage": Limit(step=0.5, unit="V", source="night.toml:9")})
    found = refusals("sweep", plan, limits)
    assert len(found) == (0 if is_fine else 1)
    for one in found:
        assert one.where == ("parameters", "tip-bias-voltage")
        assert (
            one.reason == "tip-bias-voltage = -400 mV is a step of 800 mV, the largest allowed is 500 mV (night.toml:9)"
        )
        assert "snake" in one.hint
