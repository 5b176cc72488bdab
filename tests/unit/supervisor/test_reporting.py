"""Processes are reported to the scheduler, wherever it runs, if it is afspm's."""

from __future__ import annotations

from pathlib import Path

import pytest

from afspm.basics.clock import ExperimentClock
from afspm.experiment import Experiment, ProcessStart, load
from afspm.supervisor.reporter import Reporter, reporter_of
from afspm.transport.keys import generate

CLOCK = ExperimentClock.real()
FILE = """
[microscope]
component = true
class = "Simulator"
publisher = "tcp://127.0.0.1:29100"
control_server = "tcp://127.0.0.1:29101"

[scheduler]
component = true
pubsubcache = "tcp://127.0.0.1:29102"
router = "tcp://127.0.0.1:29103"
{scheduler}

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
"""
OURS = 'class = "Scheduler"'


def experiment(folder: Path, scheduler: str = OURS, more: str = "") -> Experiment:
    file = folder / "experiment.toml"
    file.write_text(FILE.format(scheduler=scheduler) + more, encoding="utf-8")
    return load(file)


def starts(made: Experiment, *only: str) -> list[ProcessStart]:
    return made.launches(take_address=lambda: "tcp://127.0.0.1:29110", only=only)


def test_local_scheduler_gets_reports(tmp_path: Path) -> None:
    made = experiment(tmp_path)
    reporter = reporter_of(made, starts(made), CLOCK)
    assert isinstance(reporter, Reporter)
    assert reporter._launch.sockets.control == "tcp://127.0.0.1:29103"
    assert reporter._launch.name == f"supervisor:{reporter._supervisor}"


def test_part_reports_to_the_remote_scheduler_under_its_own_name(tmp_path: Path) -> None:
    made = experiment(tmp_path)
    whole, part = (reporter_of(made, starts(made, *only), CLOCK) for only in ((), ("series",)))
    assert isinstance(whole, Reporter)
    assert isinstance(part, Reporter)
    assert part._launch.sockets.control == whole._launch.sockets.control
    assert part._launch.name != whole._launch.name


@pytest.mark.parametrize("only", [(), ("series",)])
def test_scheduler_in_another_language_gets_no_unknown_requests(tmp_path: Path, only: tuple[str, ...]) -> None:
    made = experiment(tmp_path, 'command = ["python", "scheduler.py"]\nrole = "scheduler"')
    assert reporter_of(made, starts(made, *only), CLOCK) is None


def test_reporter_with_keys_expects_the_scheduler_s_key(tmp_path: Path) -> None:
    generate(tmp_path / "keys", ["microscope", "scheduler", "series", "recorder", "supervisor"])
    made = experiment(tmp_path, more='[security]\nkeys = "keys"\n')
    reporter = reporter_of(made, starts(made), CLOCK)
    assert isinstance(reporter, Reporter)
    assert reporter._launch.keys == {
        "folder": str(tmp_path / "keys"),
        "tcp://127.0.0.1:29103": "scheduler",
    }
