"""The dashboard stays in a terminal when the experiment has ended, and nowhere else."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a terminal of POSIX")
AFSPM = (sys.executable, "-m", "afspm")
EXPERIMENT = """
[clock]
speed = 600.0

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
scans = 1
end_when_done = true

[dashboard]
component = true
class = "Dashboard"
port = 0
"""


def command(folder: Path, *options: str) -> list[str]:
    file = folder / "experiment.toml"
    file.write_text(EXPERIMENT, encoding="utf-8")
    return [*AFSPM, "run", str(file), "--runs", str(folder / "runs"), "--no-report", *options]


def test_it_stays_in_a_terminal_until_ctrl_c(tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    ours, terminal = os.openpty()
    process = subprocess.Popen(command(tmp_path), stdout=terminal, stderr=terminal, start_new_session=True)
    os.close(terminal)
    said = b""
    try:
        while not (found := re.search(rb"the dashboard is at (\S+); press Ctrl-C to close", said)):
            said += os.read(ours, 4096)
        with urllib.request.urlopen(f"{found[1].decode()}/night/scans", timeout=DEADLINE_S) as answer:
            assert b'"number":1' in answer.read()
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does
        assert process.wait(DEADLINE_S) == 0
    finally:
        process.kill()
        os.close(ours)


def test_elsewhere_the_run_ends(tmp_path: Path) -> None:
    pytest.importorskip("nicegui")
    done = subprocess.run(command(tmp_path), capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=True)
    assert "the dashboard is at" in done.stdout
    assert "stays" not in done.stdout
