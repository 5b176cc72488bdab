"""A run folder of another person is data: its replay runs no code that the folder names."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import what_if_lab as lab
from deadlines import DEADLINE_S
from typer.testing import CliRunner

import afspm
from afspm.basics import ConfigError, FileError, InvalidValue
from afspm.client import port_log
from afspm.scheduler import step_log
from afspm.supervisor import own_runs
from afspm_lab.what_if import hash_seeds
from afspm_lab.what_if.closed_loop import rerun
from afspm_lab.what_if.commands import INCOMPLETE, app

LAB = "what_if_lab"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    lab.record(folder, {"judge": lab.Judge()}, until="25 min")
    return folder


class Received:
    """A night of another person, in the folder of downloads, with a module that leaves a mark when imported."""

    def __init__(self, recorded: Path, folder: Path) -> None:
        self.downloads, self.mark = folder / "downloads", folder / "mark"
        self.night = self.downloads / "night"
        shutil.copytree(recorded, self.night)
        for place in (self.night, self.downloads):
            (place / "own_.py").write_text(
                f"open({str(self.mark)!r}, 'w').close()\nfrom {LAB} import Judge\nclass Own(Judge): ...\n"
            )
        self.facts({"homes": [str(self.night), ".", "night", "downloads/night"]})

    def facts(self, facts: Any) -> None:
        (self.night / "run.json").write_text(json.dumps(facts))

    def launches(self, name: str = "judge", *, suffix: str = port_log.SUFFIX, **changes: Any) -> None:
        """Change the launch lines of a process in its log."""
        log = self.night / "requests" / f"{name}{suffix}"
        lines = [json.loads(line) for line in log.read_text().splitlines() if line]
        for kind, facts, *_ in lines:
            if kind == "life":
                facts.get("launch", facts).update(changes)
        log.write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.fixture
def received(recorded: Path, tmp_path: Path) -> Received:
    return Received(recorded, tmp_path)


def refused(received: Received, name: str = "judge") -> str:
    with pytest.raises(ConfigError) as error:
        afspm.what_if(received.night, only=[name])
    assert not received.mark.exists()
    return str(error.value)


@pytest.mark.parametrize("place", ["", "downloads", "downloads/night"])
def test_module_in_a_received_folder_is_never_imported(received: Received, tmp_path: Path, place: str) -> None:
    received.launches(**{"class": "own_.Own"})
    command = [sys.executable, "-P", "-m", "afspm", "what-if", str(received.night)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=DEADLINE_S, check=False, cwd=tmp_path / place
    )
    assert done.returncode == INCOMPLETE, done.stderr
    assert "judge was not replayed" in done.stderr
    assert "own_ is not imported: this run is not known as one of yours" in done.stderr
    assert "--import-from" in done.stderr
    assert not received.mark.exists()


def test_folder_given_by_the_user_is_trusted(received: Received) -> None:
    received.launches(**{"class": "own_.Own"})
    result = afspm.what_if(received.night, import_from=[received.night])
    assert not result.unread
    assert received.mark.exists()
    made = CliRunner().invoke(app, [str(received.night), "--import-from", str(received.downloads)])
    assert made.exit_code == 0, made.output
    with pytest.raises(FileError, match="no such folder"):
        afspm.what_if(received.night, import_from=["nowhere"])


def test_installed_module_that_declares_nothing_for_afspm_is_not_imported(received: Received) -> None:
    # this one would run the tests of the current folder
    received.launches(**{"class": "unittest.__main__.Own"})
    assert "unittest.__main__ is not imported" in refused(received)
    assert "unittest.__main__" not in sys.modules


def test_settings_of_a_received_folder_construct_no_undeclared_class(received: Received) -> None:
    program = {"class": "subprocess.Popen", "args": ["touch", str(received.mark)]}
    received.launches(settings={"factor": program})
    assert "subprocess is not imported" in refused(received)
    received.launches(settings={"factor": {"class": "afspm.components.survey.Path", "args": []}})
    assert "it is of the module pathlib" in refused(received)
    received.launches(**{"class": "subprocess.Popen"}, settings={"args": program["args"]})
    assert "can't be run" in refused(received)


def test_messages_of_a_received_folder_are_not_imported(received: Received) -> None:
    received.launches(messages=["own_"])
    assert "own_ is not imported" in refused(received)


def test_mapping_of_a_received_scheduler_is_not_imported(received: Received) -> None:
    log = received.night / "requests" / f"scheduler{step_log.SUFFIX}"
    (launch,) = {json.dumps(json.loads(line)[1]) for line in log.read_text().splitlines() if '"life"' in line[:10]}
    settings = {**json.loads(launch)["settings"], "cache": {"mapping": "own_.Own"}}
    received.launches("scheduler", suffix=step_log.SUFFIX, settings=settings)
    assert "own_ is not imported" in refused(received, "scheduler")


def test_classes_of_a_changed_received_experiment_are_not_imported(received: Received) -> None:
    (received.night / "experiment.toml").write_text(
        '[judge]\ncomponent = true\nclass = "own_.Own"\n[scheduler]\ncomponent = true\nclass = "Scheduler"\n'
    )
    changed = received.night / "changed.toml"
    changed.write_text("[judge]\nfactor = 2.0\n")
    for changes in (changed, {"judge": {"factor": "2 nm"}}):
        with pytest.raises(ConfigError, match="own_ is not imported"):
            afspm.what_if(received.night, changes)
    assert not received.mark.exists()


def test_received_run_is_not_run_again(received: Received, tmp_path: Path) -> None:
    received.facts({"simulated": True, "ended": "done", "clock": {}})
    with pytest.raises(InvalidValue, match="starts the programs that it names"):
        rerun(received.night, {}, runs=tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_look_for_the_order_of_sets_imports_nothing_from_the_current_folder(
    received: Received, monkeypatch: pytest.MonkeyPatch
) -> None:
    (received.downloads / "h5py.py").write_text((received.downloads / "own_.py").read_text())
    monkeypatch.chdir(received.downloads)
    hash_seeds.hazards(received.night, "judge")
    assert not received.mark.exists()


def test_own_run_constructs_only_processes_and_starts_no_program(received: Received) -> None:
    received.facts(own_runs.signed(received.night, []))
    program = {"class": "subprocess.Popen", "args": ["touch", str(received.mark)]}
    received.launches(settings={"factor": program})
    assert "it starts a program" in refused(received)
    received.launches(**{"class": "subprocess.Popen"}, settings={"args": program["args"]})
    assert "can't be run" in refused(received)
