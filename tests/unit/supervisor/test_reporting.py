"""Processes are reported to the scheduler, wherever it runs, if it is afspm's."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import TransportError
from afspm.basics.launch import Launch
from afspm.experiment import Experiment, ProcessStart, load
from afspm.supervisor import reporter as reporting
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


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[[Reporter | None], Launch]:
    """Return the launch line with which a reporter opens its port."""
    launches: SimpleQueue[Launch] = SimpleQueue()

    def refused(launch: Launch, clock: Clock) -> None:
        launches.put(launch)
        raise TransportError("no port is opened here")

    def started(reporter: Reporter | None) -> Launch:
        assert reporter is not None
        reporter.start()
        return launches.get(timeout=DEADLINE_S)

    monkeypatch.setattr(reporting, "open_port", refused)
    return started


def test_local_scheduler_gets_reports(tmp_path: Path, opened: Callable[[Reporter | None], Launch]) -> None:
    made = experiment(tmp_path)
    launch = opened(reporter_of(made, starts(made), CLOCK))
    assert launch.sockets.control == "tcp://127.0.0.1:29103"
    assert launch.name == f"supervisor:{reporting.computer_name()}"


def test_part_reports_to_the_remote_scheduler_under_its_own_name(
    tmp_path: Path, opened: Callable[[Reporter | None], Launch]
) -> None:
    made = experiment(tmp_path)
    whole, part = (opened(reporter_of(made, starts(made, *only), CLOCK)) for only in ((), ("series",)))
    assert part.sockets.control == whole.sockets.control
    assert part.name != whole.name


@pytest.mark.parametrize("only", [(), ("series",)])
def test_scheduler_in_another_language_gets_no_unknown_requests(tmp_path: Path, only: tuple[str, ...]) -> None:
    made = experiment(tmp_path, 'command = ["python", "scheduler.py"]\nrole = "scheduler"')
    assert reporter_of(made, starts(made, *only), CLOCK) is None


def test_reporter_with_keys_expects_the_scheduler_s_key(
    tmp_path: Path, opened: Callable[[Reporter | None], Launch]
) -> None:
    generate(tmp_path / "keys", ["microscope", "scheduler", "series", "recorder", "supervisor"])
    made = experiment(tmp_path, more='[security]\nkeys = "keys"\n')
    assert opened(reporter_of(made, starts(made), CLOCK)).keys == {
        "folder": str(tmp_path / "keys"),
        "tcp://127.0.0.1:29103": "scheduler",
    }
