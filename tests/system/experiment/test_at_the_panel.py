"""A person at an emulated Nanonis, by the vendor's own client, in a run with all of its processes."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS
from nanonis_spm import Nanonis as Client
from tests.system.experiment.experiment_lab import AfspmRun

import afspm
from afspm.client.connect import join
from afspm.model import ScopeState
from afspm.translator.emulated_controller import notice_file

EXPERIMENT = """
[clock]
speed = 20.0

[microscope]
trace = true
reply_timeout_s = "60 s"  # or a busy computer loses contact, which is a malfunction

[scheduler]
component = true
class = "Scheduler"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
pixels = [32, 32]
every = "1 s"
scans = 3
end_when_done = true
parameters = { scan-speed = "10 nm/s" }

[control]
stopped_by_hand = "pause"
"""
QUIET_S = 60.0
"""Experiment time in which nothing that acts may be sent."""
STOP, UP = 1, 0
LOOKS = 3
"""Questions for the state of a scan after which the translator has seen it run."""


@pytest.fixture
def run(tmp_path: Path) -> Iterator[AfspmRun]:
    file = tmp_path / "experiment.toml"
    file.write_text(EXPERIMENT, encoding="utf-8")
    options = ("--runs", str(tmp_path / "runs"), "--verbose", "--no-report")
    one = AfspmRun("run", str(file), str(MAKERS["nanonis"].emulated), *options, folder=tmp_path)
    yield one
    one.close()


@contextmanager
def panel(run: AfspmRun) -> Iterator[Client]:
    """Connect a person's client to the controller of the run."""
    text = notice_file(str(run.folder / "state"), "controller").read_bytes()[1:]
    host, port = json.loads(text)["address"].split(",")[0].rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=DEADLINE_S) as connection:
        yield Client(connection)


def sent_by_requests(run: AfspmRun) -> list[str]:
    """Return the exchanges with the controller that a request caused; all others only look at it."""
    lines = (run.folder / "controller.trace.jsonl").read_text(encoding="utf-8").splitlines()
    return [line for line in lines[1:] if line.endswith("}") and json.loads(line).get("command")]


def go_on(run: AfspmRun) -> subprocess.CompletedProcess[str]:
    """Let the run continue at the speed that was set at the panel, which its plan states otherwise."""
    command = [*AFSPM, "continue", str(run.folder), "--yes", "--keep"]
    return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False)


def scans(client: Client) -> bool:
    error, _, (running, *_) = client.Scan_StatusGet()
    assert error == ""
    return bool(running)


def looks(run: AfspmRun) -> int:
    """Return how often the translator has asked whether a scan runs."""
    return (run.folder / "controller.trace.jsonl").read_text(encoding="utf-8").count("Scan.StatusGet")


def set_speed(client: Client, speed_m_s: float) -> None:
    """Set the speed of later scans; the time of a line follows."""
    line_s = 1e-6 / speed_m_s
    assert client.Scan_SpeedSet(speed_m_s, speed_m_s, line_s, line_s, 1, 1.0)[0] == ""


def _until_seen(run: AfspmRun, client: Client) -> None:
    # a scan that the translator has not seen running may never have begun: how it ended is unknown then
    pace = Event()
    while not scans(client):
        pace.wait(0.05)
    asked = looks(run)
    while looks(run) < asked + LOOKS:
        pace.wait(0.05)


def act(run: AfspmRun, do: Callable[[Client], object]) -> None:
    """Act in the first scan, which takes minutes; nothing follows until a person lets the run continue, and faster."""
    run.wait_for("series is in control")
    with join(run.folder, "watcher") as scope:
        assert scope.wait_until(lambda: scope.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)
        with panel(run) as client:
            _until_seen(run, client)
            do(client)
        run.wait_for("at the microscope", "the mode is MANUAL, and nothing is sent to the microscope until")
        assert scope.wait_until(lambda: scope.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        before = sent_by_requests(run)
        scope.sleep(QUIET_S)
        assert sent_by_requests(run) == before
        assert scope.state is ScopeState.FREE
        assert not scope.control_state.problems
        with panel(run) as client:
            set_speed(client, 1e-6)
        run.wait_for("set at the microscope: scan-speed")


def test_nothing_is_sent_after_a_stop_until_a_person_lets_the_run_continue(run: AfspmRun) -> None:
    act(run, lambda client: client.Scan_Action(STOP, UP))
    done = go_on(run)
    assert done.returncode == 0, done.stderr
    assert "the measurement was stopped at the microscope" in done.stdout
    assert run.end() == 0, run.output
    found = afspm.open_run(run.folder)
    assert sorted(row.interrupted for row in found.scans) == [False, False, False, True]
    assert not run.said("device-malfunction")
    assert run.said("series measures at scan-speed 1 µm/s, set by terminal:")


def test_tip_withdrawn_in_a_scan_is_measured_with_only_after_it_is_back(run: AfspmRun) -> None:
    act(run, lambda client: client.ZCtrl_Withdraw(0, -1))
    refused = go_on(run)
    assert refused.returncode != 0
    assert "approach at the panel" in refused.stderr + refused.stdout
    with panel(run) as client:
        client.ZCtrl_OnOffSet(1)
    with join(run.folder, "watcher") as scope:
        assert scope.wait_until(lambda: scope.tip is not None and bool(scope.tip.engaged), timeout_s=DEADLINE_S)
    done = go_on(run)
    assert done.returncode == 0, done.stderr
    assert run.end() == 0, run.output
    found = afspm.open_run(run.folder)
    assert sorted(row.interrupted for row in found.scans) == [False, False, False, True]
    whole = [row for row in found.scans if not row.interrupted]
    for row in whole:
        tip = found.about(row)["tip"]
        assert tip["begin"]["engaged"] is tip["end"]["engaged"] is True
