"""Real processes: scheduler, simulated microscope, and a script that is killed in the middle."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

import afspm
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ControlLost, ExperimentEnded, FileError, NoResponse, Refused
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch, Sockets
from afspm.client import connect
from afspm.client.connect import guest_facts
from afspm.model import ControlMode, Region, ScopeState
from afspm.supervisor.ports import FreePorts

SPEED = 300.0


class Experiment:
    """Scheduler and simulator, each in a process, and the launch lines of processes that join."""

    def __init__(self, host: Callable[[Launch], Any], folder: Path) -> None:
        self.folder = folder
        self._host = host
        ports = FreePorts()
        self.scheduler_pub, self.router, self.translator_pub, self.server = (ports.address() for _ in range(4))
        self.clock = ExperimentClock.starting_now(speed=SPEED)
        self._common: dict[str, Any] = {
            "clock": self.clock.as_dict(),
            "run_dir": str(folder),
            "state_dir": str(folder / "state"),
            "request_timeout_s": 2.0,
            "simulated": True,
        }
        (folder / "state").mkdir()
        self.start_scheduler()
        self.start_translator()

    def start_scheduler(self, class_: str = "afspm.scheduler.Scheduler") -> None:
        self.scheduler = self._host(
            Launch(
                "scheduler",
                class_,
                sockets=Sockets(self.scheduler_pub, (self.translator_pub,), self.router, self.server),
                **self._common,
            )
        )

    def start_translator(self) -> None:
        self.translator = self._host(self.translator_launch)

    @property
    def translator_launch(self) -> Launch:
        sockets = Sockets(publish=self.translator_pub, serve=self.server)
        return Launch("translator", "afspm.simulation.simulator.Simulator", sockets=sockets, **self._common)

    def component_launch(self, name: str, class_: str = "", **settings: Any) -> Launch:
        sockets = Sockets(subscribe=(self.scheduler_pub,), control=self.router)
        return Launch(name, class_ and f"process_parts.{class_}", settings, sockets, **self._common)

    def start(self, name: str, class_: str, **settings: Any) -> Any:
        return self._host(self.component_launch(name, class_, **settings))

    def scans(self) -> set[tuple[str, str]]:
        """(place, time) of each scan that was seen."""
        lines = (self.folder / "seen").read_text().splitlines()
        return {(line.split()[-2], line.split()[-1]) for line in lines}


@pytest.fixture
def experiment(host: Callable[[Launch], Any], tmp_path: Path) -> Experiment:
    return Experiment(host, tmp_path)


def test_a_script_takes_its_scans(experiment: Experiment) -> None:
    survey = experiment.start("survey", "Survey", folder=str(experiment.folder))
    for i in range(3):
        survey.expect(f"tile {i} {i * 2e-6:.1e}")
    survey.expect("all")
    assert survey.exit_code() == ExitCode.DONE


@pytest.mark.parametrize("victim", ["survey", "scheduler", "translator"])
def test_killed_component_has_every_scan_once(experiment: Experiment, waiting_host: Any, victim: str) -> None:
    survey = experiment.start("survey", "Survey", folder=str(experiment.folder))
    survey.expect("tile 0")
    if victim == "survey":
        survey.close()
        survey = experiment.start("survey", "Survey", folder=str(experiment.folder))
        survey.expect("tile 0")  # kept from the earlier life
    elif victim == "scheduler":
        experiment.scheduler.close()
        experiment.start_scheduler()
    else:
        experiment.translator.close()
        # nearly started before: a survey waits for a translator for a minute
        waiting_host.tell(experiment.translator_launch.to_json())
    survey.expect("tile 1")
    survey.expect("tile 2")
    survey.expect("all")
    assert survey.exit_code() == ExitCode.DONE
    assert sorted(place for place, _ in experiment.scans()) == ["0.0e+00", "2.0e-06", "4.0e-06"]


def test_the_end_of_the_experiment_ends_every_process(experiment: Experiment) -> None:
    diary = experiment.start("diary", "Diary")
    diary.expect("start")
    ends = experiment.start("ends", "EndsEverything")
    assert ends.exit_code() == ExitCode.ENDED, ends.error_text
    assert diary.exit_code() == ExitCode.ENDED
    assert experiment.scheduler.exit_code() == ExitCode.ENDED


def test_component_that_joins_at_the_end_gets_the_signal(experiment: Experiment, waiting_host: Any) -> None:
    experiment.scheduler.close()
    experiment.start_scheduler("patient_scheduler.PatientScheduler")
    ends = experiment.start("ends", "EndsEverything")
    assert ends.exit_code() == ExitCode.ENDED, ends.error_text
    waiting_host.tell(experiment.component_launch("diary", "Diary").to_json())
    waiting_host.expect("start")
    assert waiting_host.exit_code() == ExitCode.ENDED


def test_a_notebook_joins_by_the_folder_of_the_run(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    facts = {"name": "x", "guest": guest_facts(experiment.component_launch("some"))}
    (experiment.folder / "run.json").write_text(json.dumps(facts))
    with afspm.connect(experiment.folder) as scope:
        scans = scope.scan(Region((0.0, 0.0), (1e-6, 1e-6)), shape=(8, 8), timeout_s=DEADLINE_S)
        assert scans.first.shape == (8, 8)
        assert scope.state is ScopeState.FREE
        assert scope.set("tip-bias-voltage", 250.0, "mV") == pytest.approx(250.0)
        assert scope.get("tip-bias-voltage", "V") == pytest.approx(0.25)
        with pytest.raises(Refused):
            scope.set("no-such-parameter", 1.0)
        scope.set_mode(ControlMode.MANUAL)
        with pytest.raises(ControlLost, match="MANUAL"):
            scope.scan(timeout_s=0.5)
        scope.end_experiment()
        with pytest.raises(ExperimentEnded):
            scope.wait_until(lambda: False, timeout_s=DEADLINE_S)
    experiment.scheduler.exit_code()  # it stays for a moment, to tell those who come late
    monkeypatch.setattr(connect, "JOINED_WITHIN_S", 1.0)
    with pytest.raises(NoResponse, match="the scheduler does not answer"):
        afspm.connect(experiment.folder)


def test_a_run_is_found_by_its_experiment_file_or_the_folder_of_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from afspm.client.connect import find_run

    monkeypatch.chdir(tmp_path)
    for name in ("a-1", "a-2", "b-1"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text(json.dumps({"name": name[0]}))
    (tmp_path / "runs" / "latest.txt").write_text("b-1\n")
    (tmp_path / "a.toml").write_text("")
    assert find_run(Path("a.toml")).name == "a-2"
    assert find_run(Path("runs")).name == "b-1"
    assert find_run(Path("runs/a-1")).name == "a-1"
    for nothing in ("c.toml", "elsewhere"):
        with pytest.raises(FileError):
            find_run(Path(nothing))
