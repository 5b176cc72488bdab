"""The commands of the terminal on a running experiment."""

from __future__ import annotations

import html
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from published_schemas import require_valid
from systems import can_interrupt, interrupt, kill
from typer.testing import CliRunner

from afspm.cli.app import app
from afspm.cli.follower import Follower
from afspm.cli.joining import NOT_RUNNING, person
from afspm.client.connect import find_run
from afspm.night.run import open_run
from afspm.record.run_json import latest_run

pytestmark = can_interrupt
AFSPM = (sys.executable, "-m", "afspm")
EXPERIMENT = """
name = "night"

[clock]
speed = 60.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [16, 16]
every = "10 min"
scans = 1000
"""


def afspm(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [*AFSPM, *map(str, arguments)]
    environment = {**os.environ, "COLUMNS": "200", "PYTHONIOENCODING": "utf-8"}
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, env=environment)


def afspm_here(*arguments: object, answer: str = "") -> Any:
    """A command in this process, where all is loaded: as a process of its own each is seen in another test."""
    return CliRunner().invoke(app, [*map(str, arguments)], input=answer)


class Running:
    """An experiment under way, and its output so far."""

    def __init__(self, folder: Path) -> None:
        file = folder / "experiment.toml"
        file.write_text(EXPERIMENT, encoding="utf-8")
        self.runs = folder / "runs"
        self.output: list[str] = []
        self.process = subprocess.Popen(
            [*AFSPM, "run", str(file), "--runs", str(self.runs), "--verbose", "--no-report"],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8", start_new_session=True,
        )  # fmt: skip

    def wait_for(self, pattern: str) -> None:
        """Read on until a line matches."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.output.append(line)
            if re.search(pattern, line):
                return
        raise AssertionError(f"{pattern} never came:\n{''.join(self.output)}")

    def status(self) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(afspm_here("status", self.runs, "--json").stdout)
        require_valid("status", told)
        return told

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The status, once something holds of it; each look waits for the scheduler's answer."""
        until_s = time.monotonic() + DEADLINE_S
        while True:
            said = afspm_here("status", self.runs, "--json")
            # no answer comes while the scheduler is restarted, which takes a busy computer long
            if said.exit_code == 0 and holds(told := json.loads(said.stdout)):
                return dict(told)
            assert time.monotonic() < until_s, f"never so: {said.output}"


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    running = Running(tmp_path_factory.mktemp("terminal"))
    try:
        running.wait_for(r"scan 1 of")
        yield running
    finally:
        interrupt(running.process)
        running.process.communicate(timeout=DEADLINE_S)


def test_status_says_who_is_in_control_and_how_far_it_is(night: Running) -> None:
    said = afspm("status", night.runs)
    assert said.returncode == 0, said.stderr
    for words in ("night", "SIMULATED", "AUTOMATED", "microscope", "series: ", "of 1000"):
        assert words in said.stdout
    assert "\x1b" not in said.stdout  # no colours where there is no terminal
    told = night.status()
    assert told["mode"] == "AUTOMATED"
    assert told["progress"]["series"]["of"] == 1000
    assert told["progress"]["series"]["remaining_s"] > 0
    assert told["progress"]["series"]["end"] > told["time"]
    assert told["end"]["time"] > told["time"]
    assert told["end"]["remaining_s"] > 0


def test_status_lists_the_processes(night: Running) -> None:
    told = night.until(lambda told: len(told["processes"]) >= 3)
    assert {"microscope", "scheduler", "series"} <= {one["name"] for one in told["processes"]}


def test_pause_and_continue_are_manual_and_automated(night: Running) -> None:
    assert "afspm continue" in afspm("pause", night.runs).stdout
    paused = night.status()
    assert paused["mode"] == "MANUAL"
    assert afspm("continue", night.runs).returncode == 0
    assert night.until(lambda told: told["mode"] == "AUTOMATED")["problems"] == []


def test_a_problem_is_flagged_and_cleared_by_the_person(night: Running) -> None:
    assert afspm_here("problems", night.runs, "--flag", "thermal-drift").exit_code == 0
    listed = afspm("problems", night.runs).stdout
    told = json.loads(afspm_here("problems", night.runs, "--json").stdout)
    require_valid("problems", told)
    assert [one["name"] for one in told["problems"]] == ["thermal-drift"]
    assert "tip-shape-changed" in told["known"]
    assert "thermal-drift, for" in listed
    assert f"flagged by {person()}" in listed
    assert afspm_here("problems", night.runs, "--clear", "thermal-drift").exit_code == 0
    assert "no problem is flagged" in afspm_here("problems", night.runs).stdout


def test_all_problems_are_cleared_at_once(night: Running) -> None:
    flags = ("--flag", "thermal-drift", "--flag", "tip-shape-changed")
    assert afspm_here("problems", night.runs, *flags).exit_code == 0
    done = afspm_here("problems", night.runs, "--clear-all")
    assert sorted(done.stdout.split("\n")) == ["", "cleared thermal-drift", "cleared tip-shape-changed"]
    assert "no problem is flagged" in afspm_here("problems", night.runs).stdout


def test_a_misspelt_problem_is_an_error_with_the_nearest(night: Running) -> None:
    said = afspm("problems", night.runs, "--flag", "thermal-drit")
    assert said.returncode == 1
    assert "did you mean 'thermal-drift'?" in said.stderr


def test_watch_without_a_terminal_writes_a_line_whenever_something_changes(night: Running) -> None:
    watching = subprocess.Popen([*AFSPM, "watch", str(night.runs)], stdout=subprocess.PIPE, encoding="utf-8")
    try:
        assert watching.stdout is not None
        assert "AUTOMATED" in watching.stdout.readline()
        assert afspm_here("pause", night.runs).exit_code == 0
        assert any("MANUAL" in line for line in watching.stdout)
        assert afspm_here("continue", night.runs).exit_code == 0
        assert any("AUTOMATED" in line for line in watching.stdout)
    finally:
        watching.kill()
        watching.communicate(timeout=DEADLINE_S)


def test_a_report_may_be_had_while_it_goes_on(night: Running) -> None:
    said = afspm("report", night.runs)
    assert said.returncode == 0, said.stderr
    assert "goes on" in Path(said.stdout.strip()).read_text(encoding="utf-8")


def test_run_whose_supervisor_was_killed_is_cut_off_in_every_command(tmp_path: Path) -> None:
    run = Running(tmp_path)
    run.wait_for(r"scan 1 of")
    folder = str(latest_run(run.runs))
    watching = subprocess.Popen(
        [*AFSPM, "watch", folder], stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8"
    )
    assert watching.stdout is not None
    assert "AUTOMATED" in watching.stdout.readline()
    run.process.kill()
    run.process.communicate(timeout=DEADLINE_S)
    told = f"it was cut off; `afspm run --resume {folder}` goes on with it"
    assert told in watching.communicate(timeout=DEADLINE_S)[1]
    assert watching.returncode == NOT_RUNNING
    for command in ("status", "pause"):
        said = afspm_here(command, folder)
        assert said.exit_code == NOT_RUNNING
        assert told in said.stderr
    page = Path(afspm_here("report", folder).stdout.strip()).read_text(encoding="utf-8")
    assert afspm_here("report", folder, "--quiet").output == ""
    assert afspm_here("export", folder, "--to", "csv", "--quiet").output == ""
    assert told in html.unescape(page)


def test_end_asks_first(night: Running) -> None:
    said = afspm_here("end", night.runs, answer="n\n")
    assert said.exit_code == 1
    assert night.status()["mode"] == "AUTOMATED"


def test_a_note_on_a_scan_outlives_the_scheduler(night: Running) -> None:
    night.wait_for(r"scan 2 of")
    for scan, text in (("1", "tip changed here"), ("99", "no such scan")):
        said = afspm_here("note", night.runs, text, "--scan", scan)
        assert (said.exit_code == 0) is (scan == "1"), said.stderr
    assert "there is no scan 99" in str(said.exception)
    assert "no text" in str(afspm_here("note", night.runs, "  ").exception)
    assert afspm("note", night.runs, "the door slammed").stdout == "noted\n"
    kill_scheduler(night)
    with Follower(find_run(night.runs)) as late:
        late.catch_up()
        assert [(note.who, note.text) for note in late.overview.notes] == [
            (person(), "tip changed here"),
            (person(), "the door slammed"),
        ]


def kill_scheduler(night: Running) -> None:
    processes = night.until(lambda t: t["processes"])["processes"]
    before = next(one for one in processes if one["name"] == "scheduler")
    kill(before["pid"])
    night.until(
        lambda t: any(one["name"] == "scheduler" and one["starts"] == before["starts"] + 1 for one in t["processes"])
    )


def test_status_survives_the_restart_of_the_scheduler(night: Running) -> None:
    kill_scheduler(night)
    assert night.status()["mode"] == "AUTOMATED"


def test_commands_report_that_no_run_is_going_on(tmp_path: Path) -> None:
    said = afspm("status", tmp_path)
    assert said.returncode == NOT_RUNNING
    assert "nothing runs here" in said.stderr


def test_end_ends_it_and_then_nothing_runs(night: Running) -> None:
    night.until(lambda told: told["progress"]["series"]["done"] >= 1)
    assert afspm("end", "--yes", night.runs).returncode == 0
    night.wait_for(r"everything is in")
    assert night.process.wait(DEADLINE_S) == 0
    for command in ("status", "watch", "pause", "continue", "resume", "problems"):
        said = afspm_here(command, night.runs)
        assert said.exit_code == NOT_RUNNING, said.stderr
        assert "has ended (" in said.stderr
    report = Path(afspm_here("report", night.runs).stdout.strip())
    assert afspm_here("note", night.runs, "double tip", "--scan", "1").stdout == "noted on scan 1\n"
    assert "double tip" in report.read_text(encoding="utf-8")
    with open_run(night.runs) as run:
        assert (person(), "double tip", 1) in [(note.who, note.text, note.scan) for note in run.notes]
