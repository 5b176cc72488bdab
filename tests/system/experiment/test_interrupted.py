"""Ctrl-C in a script that measures, through real processes and sockets."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from tests.system.experiment.experiment_lab import AfspmRun

import afspm
from afspm.model import ScopeState

EXPERIMENT = """
[microscope]
component = true
class = "Simulator"
initial = { scan-speed = "100 nm/s" }

[scheduler]
component = true
class = "Scheduler"
"""
SCRIPT = """
import sys
import afspm

with afspm.connect(sys.argv[1], "notebook") as scope:
    region = afspm.Region((0, 0), (5e-7, 5e-7))
    try:
        scope.scan(region, shape=(64, 64))
    except KeyboardInterrupt:
        print("interrupted", scope.in_control, flush=True)
    scope.set("scan-speed", "50 um/s")
    print("measured", scope.scan(region, shape=(8, 8)).first.shape, flush=True)
    scope.end_experiment()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a console's Ctrl-C reaches all who share it")
@pytest.mark.parametrize("times", [1, 3])
def test_the_scan_is_stopped_and_the_next_call_works(
    afspm_run: Callable[..., AfspmRun], tmp_path: Path, times: int
) -> None:
    (tmp_path / "slow.toml").write_text(EXPERIMENT, encoding="utf-8")
    run = afspm_run("slow.toml", "--runs", "runs")
    run.wait_for("scheduler .*is up")
    command = [sys.executable, "-c", SCRIPT, str(run.folder)]
    with (
        afspm.connect(run.folder, "watcher") as watcher,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8") as script,
    ):
        assert watcher.wait_until(lambda: watcher.state is ScopeState.SCANNING, timeout_s=DEADLINE_S)
        for _ in range(times):
            script.send_signal(signal.SIGINT)
        stopped = watcher.wait_until(lambda: watcher.state is ScopeState.FREE, timeout_s=DEADLINE_S)
        said, errors = script.communicate(timeout=DEADLINE_S)
    assert stopped
    assert said == "interrupted False\nmeasured (8, 8)\n", errors
    assert "interrupted; stopping the scan\nthe scan was stopped\n" in errors
    assert run.end() == 0
