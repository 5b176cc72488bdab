"""`afspm doctor` beside a real experiment on this computer: before it runs, while it runs, and with what is wrong."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S

from afspm.transport.keys import generate

EXPERIMENT = """
publish_url = "tcp://127.0.0.1:{publish}"
router_url = "tcp://127.0.0.1:{router}"

[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"
pubsubcache = "publish_url"
router = "router_url"

[series]
component = true
class = "ScanSeries"
size = ["1 um", "1 um"]
scans = 1000
"""
AFSPM = (sys.executable, "-P", "-m", "afspm")


@pytest.fixture
def ports(tmp_path: Path) -> dict[str, int]:
    with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as other:
        ports = {"publish": int(one.getsockname()[1]), "router": int(other.getsockname()[1])}
    (tmp_path / "experiment.toml").write_text(EXPERIMENT.format(**ports), encoding="utf-8")
    return ports


def doctor(folder: Path, *more: str, listen_s: float = 1.0) -> tuple[int, dict[str, Any]]:
    """Return the exit code, and what was said."""
    command = [*AFSPM, "doctor", "experiment.toml", *more, "--json", "--listen", str(listen_s)]
    told = subprocess.run(command, cwd=folder, capture_output=True, encoding="utf-8", timeout=DEADLINE_S)
    assert told.stdout, told.stderr
    return told.returncode, json.loads(told.stdout)


def codes(told: dict[str, Any]) -> set[str]:
    """Return what is not fine."""
    return {one["code"] for one in told["found"] if one["severity"] != "fine"} - {"disk-speed", "disk-space", "memory"}


def test_before_and_while_it_runs_all_is_fine(ports: dict[str, int], tmp_path: Path) -> None:
    code, told = doctor(tmp_path)
    assert (code, codes(told)) == (0, set()), told
    command = [*AFSPM, "run", "experiment.toml"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
    ) as run:
        assert run.stdout is not None
        try:
            next(line for line in run.stdout if "series is in control" in line)
            code, told = doctor(tmp_path, listen_s=10.0)  # a supervisor tells every two seconds
        finally:
            run.terminate()
            run.stdout.read()
    assert (code, codes(told)) == (0, set()), told
    assert {"key-done", "clock", "versions", "heard", "reached"} <= {one["code"] for one in told["found"]}
    assert any(one["envelope"].startswith("ProcessStates") and one["rate_hz"] > 0.0 for one in told["heard"])


def test_a_program_that_says_nothing_at_the_port_is_named(ports: dict[str, int], tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", ports["publish"])):
        code, told = doctor(tmp_path)
    assert (code, codes(told)) == (1, {"no-greeting"})


def test_errors_of_the_file_come_first(ports: dict[str, int], tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text('[series]\nscans = "many"\n', encoding="utf-8")
    code, told = doctor(tmp_path, "wrong.toml")
    assert (code, codes(told)) == (1, {"file"})


@pytest.mark.skipif(sys.platform == "win32", reason="files have no modes there")
def test_keys_that_others_may_read_or_that_are_missing_are_named(ports: dict[str, int], tmp_path: Path) -> None:
    (tmp_path / "keys.toml").write_text('[security]\nkeys = "keys"\n', encoding="utf-8")
    generate(tmp_path / "keys", ["microscope", "scheduler", "series", "recorder", "supervisor"])
    assert codes(doctor(tmp_path, "keys.toml")[1]) == set()
    (tmp_path / "keys" / "private" / "series.key_secret").chmod(0o644)
    (tmp_path / "keys" / "public" / "recorder.key").unlink()
    assert {"key-file", "key-missing"} <= codes(doctor(tmp_path, "keys.toml")[1])
