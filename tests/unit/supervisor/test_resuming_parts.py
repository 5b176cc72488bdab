"""Each part of an experiment on several computers is resumed with its own processes."""

from __future__ import annotations

import json
import socket
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import ConfigError, FileError
from afspm.experiment import Role, load
from afspm.experiment.experiment import load_expanded
from afspm.supervisor import run as running
from afspm.supervisor.resume import ResumableRun, _resumed_identity, _wait_until_gone, resume
from afspm.supervisor.run import ONLY, RUN, WITHOUT, RunOptions, dry_run, facts_to_resume

PARTS = """
[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "tcp://127.0.0.1:29001"
router = "tcp://127.0.0.1:29002"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]

[metadata]
component = true
class = "Metadata"

[notify]
command = ["python", "call.py"]
"""


@pytest.mark.parametrize(
    "options",
    [
        RunOptions(),
        RunOptions(only=("microscope", "scheduler")),
        RunOptions(only=("series", "metadata")),
        RunOptions(without=("series",)),
        RunOptions(without=("microscope", "scheduler")),
    ],
)
def test_part_is_resumed_with_its_own_processes(options: RunOptions, tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(PARTS, encoding="utf-8")
    experiment = load(tmp_path / "night.toml")
    starts = dry_run(experiment, options)
    names = [start.launch.name for start in starts]
    has_scheduler = Role.SCHEDULER in {start.role for start in starts}
    assert {"recorder", "notifier"} & set(names) == ({"recorder", "notifier"} if has_scheduler else set())
    facts = facts_to_resume(experiment, starts, options)
    (tmp_path / "experiment.toml").write_text(experiment.expanded(), encoding="utf-8")
    expanded = load_expanded(tmp_path / "experiment.toml", [tmp_path])
    for _ in range(2):  # and once more
        again = RunOptions(only=facts[ONLY], without=facts[WITHOUT])  # type: ignore[arg-type]
        starts = dry_run(expanded, again)
        assert sorted(start.launch.name for start in starts) == sorted(names)
        facts = facts_to_resume(expanded, starts, again)


def test_translator_alone_gets_the_words_about_the_feedback(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(PARTS, encoding="utf-8")
    experiment = load(tmp_path / "night.toml")
    texts = {one.launch.name: one.launch.feedback_off for one in dry_run(experiment, RunOptions(feedback_off=True))}
    assert [name for name, text in texts.items() if text] == ["microscope"]
    with pytest.raises(ConfigError, match="no translator is started here"):
        dry_run(experiment, RunOptions(only=("series",), feedback_off=True))


def test_component_added_at_a_resume_runs_in_that_life(tmp_path: Path) -> None:
    overlay = tmp_path / "overlay.toml"
    overlay.write_text('[dashboard]\ncomponent = true\nclass = "Dashboard"\n', encoding="utf-8")
    file, part = tmp_path / "experiment.toml", RunOptions(only=("microscope", "scheduler"))
    file.write_text(PARTS, encoding="utf-8")
    experiment = load(file)
    starts = dry_run(experiment, part)
    before = {start.launch.name for start in starts}
    facts: dict[str, Any] = facts_to_resume(experiment, starts, part)
    plain = ResumableRun(tmp_path, "night", load_expanded(file, [tmp_path]), facts, (tmp_path,))
    added = plain.with_overlay(overlay)
    starts = dry_run(added.experiment, added.options(RunOptions()))
    assert {start.launch.name for start in starts} == {*before, "dashboard"}
    # and in the next life not, without being missed
    facts = facts_to_resume(added.experiment, starts, added.options(RunOptions()))
    again = replace(plain, facts=facts)
    assert {start.launch.name for start in dry_run(again.experiment, again.options(RunOptions()))} == before


@pytest.mark.parametrize("file", ["state/running", "state/clock", "log.txt", "run.json"])
def test_folder_that_can_not_be_written_is_refused_in_words(file: str, tmp_path: Path) -> None:
    source = tmp_path / "experiment.toml"
    source.write_text(PARTS, encoding="utf-8")
    folder = tmp_path / "night"
    (folder / "state").mkdir(parents=True)
    (folder / file).mkdir()
    found = ResumableRun(
        folder, "night", load(source), {"clock": ExperimentClock(0.0, 0.0, 60.0).as_dict()}, (tmp_path,)
    )
    with pytest.raises(FileError, match=r"the folder of the run can't be written: .*nothing was started"):
        resume(found, RunOptions())


def test_all_processes_are_asked_at_once_whether_they_are_gone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """On Windows each refused connection takes seconds, so they are made at the same time."""
    all_asked = threading.Barrier(12, timeout=DEADLINE_S)

    def refused(address: tuple[str, int], timeout: float) -> None:
        all_asked.wait()
        raise ConnectionRefusedError

    monkeypatch.setattr(socket, "create_connection", refused)
    address = "tcp://127.0.0.1:{}"
    processes = {
        f"part {n}": {"publish": address.format(29000 + n), "serve": address.format(29100 + n)} for n in range(6)
    }
    _wait_until_gone({"processes": processes}, tmp_path)


REAL = """
[microscope]
component = true
class = "Nanonis"

[scheduler]
component = true
class = "Scheduler"
"""
EMULATED = f"""
[clock]
speed = 60.0

[controller]
component = true
class = "NanonisEmulator"
{REAL}"""


def test_experiment_without_its_emulator_does_not_have_simulated_time(tmp_path: Path) -> None:
    """The translator would talk to any controller at its address, so nothing starts."""
    (tmp_path / "night.toml").write_text(EMULATED, encoding="utf-8")
    options = RunOptions(runs=tmp_path / "runs", without=("controller",))
    with pytest.raises(ConfigError, match="nothing here proves that its microscope is simulated"):
        running.run(load(tmp_path / "night.toml"), options)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("only", [(), ("microscope", "scheduler")])
def test_simulated_time_goes_on_where_other_computers_have_parts_of_the_run(
    only: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "night.toml").write_text(PARTS, encoding="utf-8")
    experiment = load(tmp_path / "night.toml")
    before = ExperimentClock(1000.0, 5000.0, 60.0)
    facts = {"simulated": True, RUN: "a", "clock": {**before.as_dict(), "monotonic": "of an earlier boot"}}
    found = ResumableRun(tmp_path, "night", experiment, facts, (tmp_path,))
    clock = _resumed_identity(experiment, RunOptions(only=only), found).clock
    if only:
        assert clock.now_s() == pytest.approx(before.now_s(), abs=60.0)
    else:  # nothing has happened meanwhile
        assert clock.now_s() < 6000.0


@pytest.mark.parametrize(("ahead_s", "goes_on"), [(-60.0, False), (1.0, False), (3600.0, True)])
def test_real_run_goes_on_after_its_last_time_if_the_wall_clock_was_set_back(
    ahead_s: float, goes_on: bool, tmp_path: Path
) -> None:
    file, state = tmp_path / "experiment.toml", tmp_path / "state"
    file.write_text(REAL, encoding="utf-8")
    state.mkdir()
    now_s = ExperimentClock.real().now_s()
    seen_ns = round((now_s + ahead_s) * 1e9)
    (state / "microscope.json").write_text(json.dumps({"translator": {"seen_ns": seen_ns}}), encoding="utf-8")
    experiment = load_expanded(file, [tmp_path])
    found = ResumableRun(tmp_path, "night", experiment, {RUN: "run", "simulated": False}, (tmp_path,))
    clock = _resumed_identity(experiment, RunOptions(), found).clock
    assert clock.now_s() == pytest.approx(now_s + ahead_s if goes_on else now_s, abs=5.0)
    assert ("behind the run's clock" in running._ahead_of_wall(clock)) is goes_on
