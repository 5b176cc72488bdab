"""Log lines that the scheduler publishes, in one file."""

from __future__ import annotations

from pathlib import Path

from client_lab import Lab, run

from afspm.components.log_collector import LogCollector, formatted
from afspm.model import LogLine
from afspm.model.events import LogLines


def test_line_has_time_level_process_and_text() -> None:
    line = formatted(LogLine(1_700_000_000_000_000_000, "scheduler", "WARNING", "first\nsecond"))
    assert line == "2023-11-14T22:13:20.000000Z WARNING  scheduler        first\n    second"


def collect(tmp_path: Path, lines: list[LogLine], *, at_s: float = 1.0) -> str:
    lab = Lab("logs")
    lab.at(at_s, lambda: lab.publish(LogLines(tuple(lines))))
    lab.at(at_s + 2.0, lab.kill)
    run(LogCollector(level="WARNING"), lab, tmp_path, run_dir=str(tmp_path))
    return (tmp_path / "log-all.txt").read_text()


def test_published_lines_of_its_level_are_written_until_the_end(tmp_path: Path) -> None:
    text = collect(tmp_path, [LogLine(0, "tip", "INFO", "good"), LogLine(0, "tip", "WARNING", "bad")])
    assert text == "1970-01-01T00:00:00.000000Z WARNING  tip              bad\n"


def test_lines_that_the_scheduler_replays_after_a_restart_are_not_written_twice(tmp_path: Path) -> None:
    lines = [LogLine(0, "tip", "ERROR", "worse")]
    assert collect(tmp_path, lines) == collect(tmp_path, lines)
    assert collect(tmp_path, lines, at_s=2.0).count("worse") == 2
