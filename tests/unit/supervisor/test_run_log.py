from __future__ import annotations

import io
import logging
import os
import sys
import threading
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.storage import disk
from afspm.supervisor.log import COLOURS, LineReader, RunLog, colour_of


def test_a_line_on_stderr_has_the_level_that_it_begins_with() -> None:
    reader = LineReader()
    assert reader.read("stderr", "INFO the scan begins") == (logging.INFO, "the scan begins")
    assert reader.read("stderr", "WARNING: drift") == (logging.WARNING, "drift")


def test_a_traceback_belongs_to_the_error_above_it() -> None:
    reader = LineReader()
    reader.read("stderr", "ERROR it failed")
    assert reader.read("stderr", "Traceback (most recent call last):") == (
        logging.ERROR,
        "Traceback (most recent call last):",
    )


def test_a_word_that_only_begins_like_a_level_is_text() -> None:
    assert LineReader().read("stderr", "INFORMATION about it") == (logging.WARNING, "INFORMATION about it")


def test_stdout_of_a_component_is_information() -> None:
    assert LineReader().read("stdout", "ERROR of 3 nm") == (logging.INFO, "ERROR of 3 nm")


def test_file_is_synced_so_that_its_lines_outlive_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: dict[int, int] = {}

    def note(descriptor: int) -> None:
        found = os.fstat(descriptor)
        synced[found.st_ino] = found.st_size

    monkeypatch.setattr(disk, "sync_data", note)
    log = RunLog(tmp_path / "log.txt", ExperimentClock.real(), terminal=io.StringIO())
    log.write("scheduler", logging.ERROR, "the tip is in danger")
    log.close()
    disk.SYNCER.now(10.0)
    on_disk = (tmp_path / "log.txt").stat()
    assert synced[on_disk.st_ino] == on_disk.st_size > 0
    if sys.platform != "win32":
        assert tmp_path.stat().st_ino in synced


def test_file_has_every_line_and_the_terminal_lines_of_its_level(tmp_path: Path) -> None:
    terminal = io.StringIO()
    log = RunLog(tmp_path / "log.txt", ExperimentClock.real(), terminal=terminal)
    log.write("scheduler", logging.DEBUG, "a detail")
    log.write("experiment", logging.ERROR, "a scan with µm failed")
    log.close()
    text = (tmp_path / "log.txt").read_text(encoding="utf-8")
    assert "DEBUG    scheduler a detail" in text
    assert "ERROR    experiment a scan with µm failed" in text
    assert "a detail" not in terminal.getvalue()
    assert "experiment ERROR a scan with µm failed" in terminal.getvalue()


def test_file_has_the_experiment_time_if_different_from_real_time(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", ExperimentClock.starting_now(start_s=1e9), terminal=io.StringIO())
    log.write("scheduler", logging.INFO, "begin")
    log.close()
    assert "[2001-09-" in (tmp_path / "log.txt").read_text(encoding="utf-8")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk here that is always full")
def test_a_full_disk_does_not_end_the_run() -> None:
    terminal = io.StringIO()
    log = RunLog(Path("/dev/full"), ExperimentClock.real(), terminal=terminal)
    log.write("scheduler", logging.INFO, "going on")
    log.close()
    assert "going on" in terminal.getvalue()


def test_closed_terminal_does_not_end_the_run(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.txt", ExperimentClock.real(), terminal=_Gone())
    log.write("scheduler", logging.INFO, "still here")
    log.close()
    assert "still here" in (tmp_path / "log.txt").read_text(encoding="utf-8")


def test_blocked_terminal_delays_nothing(tmp_path: Path) -> None:
    """Text is marked in the terminal, or Ctrl-S was pressed."""
    terminal = _Stopped()
    log = RunLog(tmp_path / "log.txt", ExperimentClock.real(), terminal=terminal, shown_within_s=0.01)
    for number in range(3):
        log.write("scheduler", logging.INFO, f"line {number}")
    log.close()
    terminal.goes_on.set()
    assert "line 2" in (tmp_path / "log.txt").read_text(encoding="utf-8")


@pytest.mark.skipif(sys.platform == "win32", reason="a pipe that nobody reads stands in for a disk that hangs")
def test_hanging_disk_delays_nothing_and_is_shown(tmp_path: Path) -> None:
    file, told = tmp_path / "log.txt", threading.Event()
    os.mkfifo(file)
    reader = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
    log = RunLog(file, ExperimentClock.real(), terminal=io.StringIO(), shown_within_s=0.01, slow_s=0.05)
    log.listener = lambda name, level, text: told.set() if level == logging.WARNING else None

    def write() -> None:
        while not told.wait(0.01):
            log.write("scheduler", logging.INFO, "x" * 20_000)

    writing = threading.Thread(target=write, daemon=True)
    writing.start()
    writing.join(DEADLINE_S)
    assert told.is_set()
    os.close(reader)
    log.close()


def test_a_terminal_shows_the_name_in_its_colour(tmp_path: Path) -> None:
    terminal = _Colourful()
    log = RunLog(tmp_path / "log.txt", ExperimentClock.real(), terminal=terminal)
    log.write("scheduler", logging.INFO, "[bold]not markup[/bold]")
    log.close()
    assert "\x1b[" in terminal.getvalue()
    assert "[bold]not markup[/bold]" in terminal.getvalue()


def test_a_name_keeps_its_colour() -> None:
    assert colour_of("scheduler") == "cyan"
    assert {colour_of(f"component {n}") for n in range(200)} == set(COLOURS)


class _Stopped(io.StringIO):
    def __init__(self) -> None:
        super().__init__()
        self.goes_on = threading.Event()

    def write(self, text: str) -> int:
        self.goes_on.wait()
        return len(text)


class _Gone(io.StringIO):
    def write(self, text: str) -> int:
        raise BrokenPipeError


class _Colourful(io.StringIO):
    def isatty(self) -> bool:
        return True
