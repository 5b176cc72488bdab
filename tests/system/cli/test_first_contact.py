"""The first contact with a controller that runs as a process of its own: asked, written down, and run with limits."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

AFSPM = (sys.executable, "-P", "-m", "afspm")
SAMPLE = """
[clock]
speed = 60.0
[microscope]
component = true
class = "Simulator"
seed = 3
[scheduler]
component = true
class = "Scheduler"
[series]
component = true
class = "ScanSeries"
size = ["100 nm", "100 nm"]
pixels = [32, 32]
scans = 1
end_when_done = true
"""


@pytest.fixture
def controller(tmp_path: Path) -> Iterator[str]:
    """The address of an emulated Nanonis."""
    command = [*AFSPM, "emulate", "nanonis", "--folder", "emulated", "--speed", "20"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, encoding="utf-8") as process:
        assert process.stdout is not None
        yield process.stdout.readline().partition("listening at ")[2].partition(",")[0]
        process.terminate()


def told(folder: Path, *words: str) -> tuple[int, str]:
    done = subprocess.run([*AFSPM, *words], cwd=folder, capture_output=True, encoding="utf-8", timeout=DEADLINE_S)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow  # two runs of afspm
def test_controller_is_asked_written_down_and_run_with_what_was_read(tmp_path: Path, controller: str) -> None:
    (tmp_path / "experiment.toml").write_text(SAMPLE, encoding="utf-8")
    code, text = told(tmp_path, "doctor", "--on", "nanonis", "--at", controller, "--json")
    assert code == 0, text
    lines = {one["where"]: one["what"] for one in json.loads(text)["found"] if one["code"] == "reading"}
    assert lines["tip-bias-voltage"].startswith("100 mV (")
    assert lines["zctrl-setpoint"].startswith("100 pA (")

    code, text = told(tmp_path, "new", "instrument", "nanonis", controller)
    assert code == 0, text
    code, text = told(tmp_path, "doctor", "instrument.toml")  # no experiment: it is asked all the same
    assert code == 1
    assert "tip-bias-voltage: 100 mV (" in text
    assert "a file of an instrument is checked over an experiment" in text
    file = tmp_path / "instrument.toml"
    limits = tomllib.loads(file.read_text(encoding="utf-8"))["limits"]
    assert limits["tip-bias-voltage"] == {"min": "-1 V", "max": "1 V", "step": "1 V"}
    assert limits["zctrl-setpoint"] == {"min": "10 pA", "max": "500 pA", "step": "100 pA"}
    code, text = told(tmp_path, "new", "instrument", "nanonis", controller)
    assert code == 1
    assert "the file is there already" in text

    code, text = told(tmp_path, "run", "experiment.toml", "instrument.toml", "--no-report")
    assert code == 0, text
    bare = file.read_text(encoding="utf-8").partition("[limits]")[0]
    file.write_text(bare, encoding="utf-8")
    code, text = told(tmp_path, "run", "experiment.toml", "instrument.toml")
    assert code == 1
    assert "no limits are set for a real controller" in text
    file.write_text(bare + "[limits]\nnone = true\n", encoding="utf-8")
    code, text = told(tmp_path, "run", "experiment.toml", "instrument.toml", "--no-report")
    assert code == 0, text


@pytest.mark.skipif(sys.platform == "win32", reason="there is no such terminal there")
@pytest.mark.parametrize(("answer", "runs"), [("n", False), ("y", True)])
def test_run_without_limits_asks_at_a_terminal_with_the_values_in_force(
    answer: str, runs: bool, tmp_path: Path, controller: str
) -> None:
    (tmp_path / "experiment.toml").write_text(SAMPLE, encoding="utf-8")
    assert told(tmp_path, "new", "instrument", "nanonis", controller)[0] == 0
    file = tmp_path / "instrument.toml"
    file.write_text(file.read_text(encoding="utf-8").partition("[limits]")[0], encoding="utf-8")
    ours, terminal = os.openpty()
    try:
        os.write(ours, f"{answer}\n".encode())
        done = subprocess.run(
            [*AFSPM, "run", "experiment.toml", "instrument.toml", "--no-report"],
            cwd=tmp_path,
            stdin=terminal,
            capture_output=True,
            encoding="utf-8",
            timeout=DEADLINE_S,
        )
    finally:
        os.close(terminal)
        os.close(ours)
    assert "tip-bias-voltage: 100 mV (" in done.stdout
    assert "nothing that a component asks for is refused. Run?" in done.stdout
    assert (done.returncode == 0) is runs, done.stdout + done.stderr
    assert (tmp_path / "runs").exists() is runs


def test_silent_and_missing_controllers_are_faults_with_a_remedy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        taken = silent.getsockname()[1]
        code, text = told(tmp_path, "doctor", "--on", "nanonis", "--at", f"127.0.0.1:{taken}")
        assert code == 1
        assert "another client has this port" in text
    code, text = told(tmp_path, "doctor", "--on", "nanonis", "--at", f"127.0.0.1:{taken}")
    assert code == 1
    assert text.splitlines()[0].startswith(f"error   127.0.0.1:{taken}: no contact: no connection")
    assert "is Nanonis running, with this port open" in text


def test_other_maker_and_address_without_one_are_refused(tmp_path: Path) -> None:
    code, text = told(tmp_path, "doctor", "--on", "nanoniss")
    assert code == 1
    assert "did you mean 'nanonis'" in text
    assert told(tmp_path, "doctor", "--at", "127.0.0.1:1")[0] == 2
