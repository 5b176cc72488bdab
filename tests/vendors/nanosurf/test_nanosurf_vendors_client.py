"""The maker's own client (nanosurf-core), unmodified, drives the emulated Studio as the maker's examples do."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nanosurf_bench import Emulated

import afspm

Run = Callable[[str, str], dict[str, object]]
CLIENT = importlib.util.find_spec("nanosurf")
BEGINS = """
import json, sys
from nanosurf.studio import Studio, StudioScriptError
host, port = sys.argv[1].split(":")
studio = Studio(host, int(port))
"""
DEADLINE_S = 60.0


@pytest.fixture
def client(tmp_path: Path) -> Run:
    """Run a script with the client in a process of its own; it writes into its own folder, so it has a copy."""
    if CLIENT is None or CLIENT.origin is None:
        pytest.skip("nanosurf-core is not installed")
    site = tmp_path / "site"
    shutil.copytree(Path(CLIENT.origin).parent, site / "nanosurf")

    def run(address: str, script: str) -> dict[str, object]:
        done = subprocess.run(
            [sys.executable, "-c", BEGINS + script, address],
            capture_output=True,
            encoding="utf-8",
            timeout=DEADLINE_S,
            env={**os.environ, "PYTHONPATH": str(site)},
        )
        assert done.returncode == 0, done.stdout + done.stderr
        found = json.loads(done.stdout.splitlines()[-1])
        assert isinstance(found, dict)
        return found

    return run


def emulated() -> Emulated:
    return Emulated(seed=2, start_s=0.01, file_s=0.01)


def test_it_finds_the_application_and_its_release(tmp_path: Path, client: Run) -> None:
    with emulated().running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
listed = studio.select_main_session().session.list()
print(json.dumps({"version": studio.version(), "list": listed}))
""",
        )
    assert told == {"version": [19, 0], "list": ["91-01-000"]}


def test_it_measures_as_the_makers_example_does(tmp_path: Path, client: Run) -> None:
    made = emulated()
    with made.running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
session = studio.select_measurement_session()
imaging, storage = session.workflow.imaging, session.workflow.data.storage
imaging.scan_range_fast_axis = 2e-7
imaging.scan_range_slow_axis = 1e-7
imaging.points_per_line = 24
imaging.lines_per_frame = 12
imaging.line_rate = 60.0
imaging.slow_axis_scan_direction = imaging.slow_axis_scan_direction_enum.downward
storage.file_basename = "demo_[INDEX]"
approached = session.workflow.approach.approach()
scanned = imaging.acquire()
session.workflow.spectroscopy.acquire()
session.workflow.approach.withdraw()
print(json.dumps({
    "head": session.workflow.device.scan_head.name, "unit": imaging.rotation_unit, "points": imaging.points_per_line,
    "setpoint": session.workflow.z_control.setpoint, "messages": [approached["message"], scanned["message"]],
}))
""",
        )
        assert not made.rig.engaged
        wait_for_files(tmp_path / "gallery", 2)
    assert told == {"head": "SIMULATED", "unit": "°", "points": 24, "setpoint": 0.7, "messages": ["", ""]}
    scan = made.rig.scan
    assert scan is not None
    assert (scan.shape, scan.region.size_m, scan.upwards) == ((12, 24), (2e-7, 1e-7), False)
    content = afspm.read(tmp_path / "gallery" / "demo_00001.nhf")
    np.testing.assert_allclose(content.scans[0].values, scan.channels()["Height"][1], atol=1e-15)


def test_an_error_of_a_script_is_an_error_of_the_client(tmp_path: Path, client: Run) -> None:
    with emulated().running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
session = studio.select_measurement_session()
said = []
for value in (1e9, 0):
    try:
        session.workflow.imaging.points_per_line = value
    except StudioScriptError as error:
        said.append(str(error))
print(json.dumps({"said": said}))
""",
        )
    assert told["said"] == [
        "Script Error: imaging.points_per_line: 1000000000.0 is not within 2 to 8192",
        "Script Error: imaging.points_per_line: 0 is not within 2 to 8192",
    ]


def wait_for_files(folder: Path, count: int) -> None:
    """Wait until so many whole files are there."""
    deadline_s = time.monotonic() + DEADLINE_S
    while time.monotonic() < deadline_s:
        try:
            if len([afspm.read(path) for path in folder.glob("*.nhf")]) == count:
                return
        except afspm.AfspmError:
            pass
        time.sleep(0.02)  # another process's files
    raise AssertionError(f"there are {list(folder.iterdir())}")
