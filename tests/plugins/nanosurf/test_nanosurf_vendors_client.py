"""The maker's own client (nanosurf-core), unmodified, drives the emulated Studio as in the maker's examples."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from deadlines import DEADLINE_S
from tests.plugins.nanosurf.nanosurf_bench import Emulated

import afspm
from afspm.basics import AfspmError, ExperimentClock

Run = Callable[..., dict[str, object]]
CLIENT = importlib.util.find_spec("nanosurf")
SCRIPTS = Path(CLIENT.origin if CLIENT and CLIENT.origin else "/").parent / "apps" / "studio_scripting"
BEGINS = """
import json, sys
from nanosurf.studio import Studio, StudioScriptError
host, port = sys.argv[1].split(":")
studio = Studio(host, int(port))
"""
ELSEWHERE = """
import json, runpy, socket, sys
host, port = sys.argv[1].split(":")
connect = socket.socket.connect
socket.socket.connect = lambda made, _: connect(made, (host, int(port)))
"""
"""For programs that connect to Studio's usual port."""


@pytest.fixture
def client(tmp_path: Path) -> Run:
    """Run a script with the client in a process; the client gets a copy of its own, since it writes to its folder."""
    if CLIENT is None or CLIENT.origin is None:
        pytest.skip("nanosurf-core is not installed")
    site = tmp_path / "site"
    large = shutil.ignore_patterns("example_data")
    shutil.copytree(Path(CLIENT.origin).parent, site / "nanosurf", ignore=large)

    def run(address: str, script: str, begins: str = BEGINS) -> dict[str, object]:
        done = subprocess.run(
            [sys.executable, "-c", begins + script, address],
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


class Observed(Emulated):
    """An emulated Studio that notifies after each of its steps, in which it writes files."""

    def __init__(self) -> None:
        super().__init__(seed=2, start_s=0.01, file_s=0.01)
        self._stepped = threading.Condition()

    def tick(self, now_s: float) -> float | None:
        again_s = super().tick(now_s)
        with self._stepped:
            self._stepped.notify_all()
        return again_s

    def wait_for_files(self, folder: Path, count: int) -> None:
        """Wait for a number of complete files."""
        with self._stepped:
            there = self._stepped.wait_for(lambda: complete_files(folder) == count, DEADLINE_S)
        assert there, f"there are {list(folder.iterdir())}"


def complete_files(folder: Path) -> int:
    try:
        return len([afspm.read(path) for path in folder.glob("*.nhf")])
    except AfspmError:  # half of a file is written
        return 0


def test_client_finds_the_application_and_its_release(tmp_path: Path, client: Run) -> None:
    with Observed().running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
listed = studio.select_main_session().session.list()
print(json.dumps({"version": studio.version(), "list": listed}))
""",
        )
    assert told == {"version": [19, 0], "list": ["91-01-000"]}


def test_client_measures_as_in_the_makers_example(tmp_path: Path, client: Run) -> None:
    made = Observed()
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
        made.wait_for_files(tmp_path / "gallery", 2)
    assert told == {"head": "SIMULATED", "unit": "°", "points": 24, "setpoint": 0.7, "messages": ["", ""]}
    scan = made.rig.scan
    assert scan is not None
    assert (scan.shape, scan.region.size_m, scan.upwards) == ((12, 24), (2e-7, 1e-7), False)
    content = afspm.read(tmp_path / "gallery" / "demo_00001.nhf")
    np.testing.assert_allclose(content.scans[0].values, scan.channels()["Height"][1], atol=1e-15)


def test_the_makers_demo_runs_to_its_end(tmp_path: Path, client: Run) -> None:
    made = Observed()
    with made.running(tmp_path / "gallery", ExperimentClock.starting_now(speed=1000.0)) as address:
        told = client(
            address,
            f"""
from contextlib import redirect_stdout
from io import StringIO
printed = StringIO()
with redirect_stdout(printed):
    runpy.run_path({str(SCRIPTS / "studio_scripting.py")!r}, run_name="__main__")
print(json.dumps({{"printed": printed.getvalue()}}))
""",
            ELSEWHERE,
        )
        made.wait_for_files(tmp_path / "gallery", 1)
    assert str(told["printed"]).endswith("Session complete.\n"), told
    assert "Studio error" not in str(told["printed"])
    (file,) = (tmp_path / "gallery").glob("demo_20??-??-??_00001.nhf")
    assert afspm.read(file).scans[0].values.shape == (256, 256)


def test_every_cell_of_the_makers_notebook_runs(tmp_path: Path, client: Run) -> None:
    made = Observed()
    with made.running(tmp_path / "gallery", ExperimentClock.starting_now(speed=1000.0)) as address:
        told = client(
            address,
            f"""
from pathlib import Path
cells = json.loads(Path({str(SCRIPTS / "Studio_Scripting_Level_1.ipynb")!r}).read_text(encoding="utf-8"))["cells"]
code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
names, failed = {{}}, []
for number, source in enumerate(code, 1):
    try:
        exec(source, names)
    except Exception as error:  # any error of a cell is reported with its source
        failed.append(f"cell {{number}}: {{type(error).__name__}} {{error}}")
studio = names["session"].workflow
print(json.dumps({{
    "failed": failed, "cells": len(code), "mode": studio.mode.name, "gain": studio.z_control.i_gain,
    "setpoint": studio.z_control.setpoint, "queue": studio.automation.queue_size(),
    "items": [studio.workspace.get_item_name(one) for one in studio.workspace.all_item_ids()],
    "spring": studio.probe.current_spring_constant,
}}))
""",
            ELSEWHERE,
        )
        content = [afspm.read(path) for path in sorted((tmp_path / "gallery").glob("*.nhf"))]
    assert (told["failed"], told["cells"]) == ([], 62)
    assert told["mode"] == "wavemode_nma"
    assert told["queue"] == 0
    assert told["setpoint"] == pytest.approx(0.3)
    assert told["spring"] == pytest.approx(made.rig.world.settings.force.spring_n_per_m)
    names = [
        "Hello World",
        "New Grid",
        "My spec point",
        *(f"{kind} {n}" for kind in ("Frame", "Point") for n in (1, 2, 3)),
    ]
    assert told["items"] == names
    frames = [one.scans[0].region.center_m for one in content if one.scans]
    points = [len(one.spectra) for one in content if one.spectra]
    assert points == [256, 1, 1]
    queued = [(-20e-6, 0.0), (0.0, 0.0), (20e-6, 0.0), *[(-20e-6, 0.0)] * 3]
    np.testing.assert_allclose(frames[-6:], queued, atol=1e-12)


def test_values_have_limits_and_the_setpoint_has_units(tmp_path: Path, client: Run) -> None:
    with Observed().running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
session = studio.select_measurement_session()
control, calibration = session.workflow.z_control, session.workflow.probe.cantilever_calibration
found = {"V": [control.setpoint, control.setpoint_min, control.setpoint_max], "units": control.setpoint_units}
control.setpoint_unit = "m"
found["m"] = [control.setpoint, control.setpoint_min, control.setpoint_max]
control.setpoint = 30e-9
control.setpoint_unit = "V"
found["after"] = control.setpoint
printed = []
for call in (
    lambda: setattr(control, "setpoint_unit", "N"), calibration.apply,
    lambda: session.workflow.spectroscopy.select_cycle_by_id("none"),
    lambda: session.workflow.spectroscopy.select_cycle(7),
    lambda: session.workflow.workspace.set_item_size("none", 1, 1),
    lambda: session.workflow.workspace.load_from_file("../../outside.txt"),
    lambda: session.workflow.workspace.load_from_file("C:\\temp\\none.xml"),
    lambda: session.workflow.automation.add_to_queue("none"),
    lambda: session.workflow.workspace.add_point("x" * 1000, 0, 0),
):
    try:
        call()
    except StudioScriptError as error:
        printed.append(str(error))
print(json.dumps({**found, "printed": printed}))
""",
        )
    sensitivity = 60e-9 * 1.2  # nominal value of the cantilever, before the calibration
    assert told["V"] == [0.7, -10.0, 10.0]
    assert told["m"] == pytest.approx([0.7 * sensitivity, -10.0 * sensitivity, 10.0 * sensitivity])
    assert told["after"] == pytest.approx(30e-9 / sensitivity)
    assert told["units"] == ["V", "m"]
    assert len(told["printed"]) == 9  # type: ignore[arg-type]


def test_script_error_is_raised_by_the_client(tmp_path: Path, client: Run) -> None:
    with Observed().running(tmp_path / "gallery") as address:
        told = client(
            address,
            """
session = studio.select_measurement_session()
printed = []
for value in (1e9, 0):
    try:
        session.workflow.imaging.points_per_line = value
    except StudioScriptError as error:
        printed.append(str(error))
print(json.dumps({"printed": printed}))
""",
        )
    assert told["printed"] == [
        "Script Error: imaging.points_per_line: 1000000000.0 is not within 2 to 8192",
        "Script Error: imaging.points_per_line: 0 is not within 2 to 8192",
    ]
