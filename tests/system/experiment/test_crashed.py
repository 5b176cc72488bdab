"""A crash of a process is found, though the supervisor starts the process again and the run ends as usual."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from benchmarks.crashes import CrashWatch
from systems import WINDOWS
from tests.system.experiment.experiment_lab import Run


@pytest.mark.crashes
@pytest.mark.skipif(WINDOWS, reason="Windows has no signals that kill a process")
def test_crash_of_a_restarted_scheduler_is_found_in_the_log_of_the_run(run: Run, tmp_path: Path) -> None:
    # faults A1
    watch = CrashWatch()
    until = tmp_path / "until"
    one = run(over=f'[witness]\nuntil = "{until.as_posix()}"\n')
    one.wait_up("scheduler", 1)
    os.kill(one.pid("scheduler"), signal.SIGSEGV)
    one.wait_up("scheduler", 2)
    until.touch()
    assert one.end() == 0, one.output
    (found,) = watch.in_logs(tmp_path)
    assert "scheduler" in found
    assert "SIGSEGV" in found
