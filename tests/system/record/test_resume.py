"""Runs that can be resumed, and refusals."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

import afspm
from afspm.basics.clock import NS_PER_S
from afspm.basics.errors import ConfigError, FileError
from afspm.plugins.web.commands import resumed_with_page
from afspm.record.run_json import STATE_DIR
from afspm.record.run_lock import lock_run
from afspm.supervisor import resume
from afspm.supervisor.run import RunOptions

EXPERIMENT = """
[clock]
start = 2026-03-14T20:00:00Z
speed = 600.0

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"

[short]
component = true
class = "short.Short"
"""
COMPONENT = """
from afspm import Component


class Short(Component):
    def run(self):
        self.memory["lives"] = self.memory.get("lives", 0) + 1
        self.memory.setdefault("began_s", self.clock.now_s())
        self.memory["now_s"] = self.clock.now_s()
        self.memory.save()
        if self.memory["lives"] > 1:
            self.scope.end_experiment()
        self.scope.scan(shape=(16, 16), key="a")
        while True:
            self.scope.sleep(60.0)
"""


def afspm_run(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "afspm", "run", "--no-report", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
    )


def output_until(process: subprocess.Popen[str], wanted: str) -> str:
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if wanted in line:
            return line
    raise AssertionError(f"{wanted!r} did not come:\n{''.join(lines)}")


def memory(run: Path) -> dict[str, Any]:
    kept: dict[str, Any] = json.loads((run / "state" / "short.json").read_text(encoding="utf-8"))
    return kept


def test_stopped_run_is_resumed_and_an_ended_one_is_not(tmp_path: Path) -> None:
    beside, away = tmp_path / "lab", tmp_path / "away"
    beside.mkdir()
    away.mkdir()
    (beside / "night.toml").write_text(EXPERIMENT, encoding="utf-8")
    (beside / "short.py").write_text(COMPONENT, encoding="utf-8")  # found again though the run is elsewhere
    first = afspm_run(away, str(beside / "night.toml"))
    run = Path(output_until(first, "processes, into").strip().rpartition(", into ")[2])
    output_until(first, "is in control")
    with pytest.raises(FileError, match="still going on"):
        resume.resume(resume.find(run), RunOptions())
    first.kill()  # the supervisor alone: the others find out by themselves
    first.wait()
    assert first.stdout is not None
    first.stdout.close()
    before = memory(run)
    seen_ns = resume.last_seen_ns(run)
    again = afspm_run(away, "--resume", "runs")
    told = again.communicate(timeout=DEADLINE_S)[0]
    assert again.returncode == 0, told
    after = memory(run)
    assert after["lives"] == 2, told
    assert after["began_s"] == before["began_s"]
    assert after["now_s"] > seen_ns / NS_PER_S
    assert after["now_s"] - before["now_s"] < 6 * 3600, "time stands still while nobody is there"
    assert (run / "log.txt").read_text(encoding="utf-8").count("processes, into") == 2
    with pytest.raises(ConfigError, match="has ended"):
        resume.find(run)


def test_killed_run_is_resumed_with_an_added_dashboard(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(EXPERIMENT, encoding="utf-8")
    waiting = COMPONENT.replace("self.scope.end_experiment()", "self.scope.sleep(60.0)")
    (tmp_path / "short.py").write_text(waiting, encoding="utf-8")
    first = afspm_run(tmp_path, "night.toml")
    run = Path(output_until(first, "processes, into").strip().rpartition(", into ")[2])
    output_until(first, "is in control")
    first.kill()
    first.wait()
    assert first.stdout is not None
    first.stdout.close()
    again = afspm_run(tmp_path, "--resume", "runs", "--dashboard")
    output_until(again, "the dashboard is at http://127.0.0.1:")
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    assert set(facts["processes"]) == {"microscope", "scheduler", "short", "recorder", "dashboard"}
    again.terminate()
    again.communicate(timeout=DEADLINE_S)


NOTING = """
from afspm import Component


class Short(Component):
    def run(self):
        lives = self.memory["lives"] = self.memory.get("lives", 0) + 1
        self.memory.save()
        scans = self.scope.scan(shape=(16, 16), key="a")
        self.scope.note("the tip is new", scan=scans, key="a")
        self.log.info("noted in life %d", lives)
        if lives > 1:
            self.scope.note("the night is over", key="end")
            self.scope.end_experiment()
        while True:
            self.scope.sleep(60.0)
"""


def test_notes_with_a_key_are_written_once_over_a_kill_and_a_resume(tmp_path: Path) -> None:
    (tmp_path / "night.toml").write_text(EXPERIMENT, encoding="utf-8")
    (tmp_path / "short.py").write_text(NOTING, encoding="utf-8")
    first = afspm_run(tmp_path, "night.toml")
    run = tmp_path / output_until(first, "processes, into").strip().rpartition(", into ")[2]
    output_until(first, "noted in life 1")
    first.kill()
    first.wait()
    assert first.stdout is not None
    first.stdout.close()
    again = afspm_run(tmp_path, "--resume", "runs")
    output_until(again, "noted in life 2")
    again.communicate(timeout=DEADLINE_S)
    with afspm.open_run(run) as record:
        assert [note.text for note in record.notes] == ["the tip is new", "the night is over"]


def test_run_with_a_dashboard_is_resumed_with_it(tmp_path: Path) -> None:
    own = EXPERIMENT + '\n[page]\ncomponent = true\nclass = "Dashboard"\n'
    (tmp_path / "experiment.toml").write_text(own, encoding="utf-8")
    (tmp_path / "short.py").write_text(COMPONENT, encoding="utf-8")
    (tmp_path / "run.json").write_text("{}", encoding="utf-8")
    (tmp_path / "state").mkdir()
    found = resume.find(tmp_path)
    assert resumed_with_page(found) == found
    assert found.added == ()


def test_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError):
        resume.find(tmp_path)
    (tmp_path / "run.json").write_text("{}", encoding="utf-8")
    with pytest.raises(FileError, match="not the folder of a run"):
        resume.find(tmp_path)
    (tmp_path / "run.json").write_text("half a", encoding="utf-8")
    with pytest.raises(FileError, match=r"run\.json"):
        resume.find(tmp_path)


@pytest.mark.parametrize("content", [None, b"", b"no journal at all", b"SQLite format 3\0 and then nothing"])
def test_damaged_journal_does_not_prevent_a_resume(tmp_path: Path, content: bytes | None) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "microscope.json").write_text('{"seen_ns": 17}', encoding="utf-8")
    if content is not None:
        (tmp_path / "journal.sqlite").write_bytes(content)
    assert resume.last_seen_ns(tmp_path) == 17


def test_lock_is_exclusive_and_released_at_exit(tmp_path: Path) -> None:
    (tmp_path / STATE_DIR).mkdir()
    with lock_run(tmp_path), pytest.raises(FileError, match="still going on"):
        lock_run(tmp_path).__enter__()
    with lock_run(tmp_path):
        pass


def test_resume_at_another_speed_is_refused(tmp_path: Path) -> None:
    process = afspm_run(tmp_path, "--resume", "runs", "--speed", "2")
    told = process.communicate(timeout=DEADLINE_S)[0]
    assert process.returncode != 0
    assert "a run is resumed as it was started" in told
