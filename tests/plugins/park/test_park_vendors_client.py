"""The maker's own client (smartremote), unmodified, drives the emulated SmartScan."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from tests.plugins.park.park_bench import Emulated

from afspm.basics import ExperimentClock

Run = Callable[[str, str], dict[str, object]]
BEGINS = """
import json, sys
from SmartRemote import SmartRemote
SmartRemote.address = sys.argv[1]
remote = SmartRemote()
"""


@pytest.fixture
def client() -> Run:
    """Run a script with the client in a process."""
    if importlib.util.find_spec("SmartRemote") is None:
        pytest.skip("smartremote is not installed")

    def run(address: str, script: str) -> dict[str, object]:
        done = subprocess.run(
            [sys.executable, "-c", BEGINS + script, address], capture_output=True, encoding="utf-8", timeout=DEADLINE_S
        )
        assert done.returncode == 0, done.stdout + done.stderr
        found = json.loads(done.stdout.splitlines()[-1])
        assert isinstance(found, dict)
        return found

    return run


def test_client_queries_are_answered(tmp_path: Path, client: Run) -> None:
    with Emulated(seed=2).running(tmp_path / "data") as address:
        told = client(
            address,
            """
print(json.dumps({
    "connected": remote.check_connection(), "runs": remote.check_status(), "scans": remote.query_scan_status(),
    "stage": remote.query_stage_pos(), "frame": remote.query_geometry(),
}))
""",
        )
    frame = {"pixelHeight": 128, "pixelWidth": 128, "width": 1.0, "height": 1.0, "offsetX": 0.0, "offsetY": 0.0}
    assert told == {
        "connected": "true",
        "runs": "false",
        "scans": "false",
        "stage": {"x": 0.0, "y": 0.0, "z": 0.0},
        "frame": {**frame, "rotation": 0.0},
    }


@pytest.mark.parametrize("replies", ["at-end", "at-once"])
def test_client_approaches_scans_and_withdraws(tmp_path: Path, client: Run, replies: str) -> None:
    made = Emulated(seed=2, start_s=0.01, file_s=0.01, replies=replies)
    with made.running(tmp_path / "data") as address:
        told = client(
            address,
            """
frame = {"pixelHeight": 12, "pixelWidth": 24, "width": 0.2, "height": 0.1, "offsetX": 0.3, "offsetY": -0.1}
remote.run(f"spm.scan.setScanGeometry({json.dumps({**frame, 'rotation': 30})})")
remote.run("spm.scan.rate = 60")
remote.run("spm.approach.start('q+s')")
remote.run("spm.scan.startImageScan()")
ended = remote.query_scan_status()
remote.run("spm.zscanner.retractAll()")
script = "var xy = spm.xystage.pos\\nvar told = xy.x + ',' + xy.y\\ntold;"
print(json.dumps({"value": remote.run(script)["value"], "ended": ended, "frame": remote.query_geometry()}))
""",
        )
        assert not made.rig.engaged
    assert (told["value"], told["ended"]) == ("0,0", "false")
    scan = made.rig.scan
    assert scan is not None
    assert (scan.shape, scan.region.size_m) == ((12, 24), pytest.approx((2e-7, 1e-7)))
    assert scan.region.center_m == pytest.approx((3e-7, -1e-7))


def test_client_takes_curves_at_the_tip(tmp_path: Path, client: Run) -> None:
    made = Emulated(seed=2, file_s=0.01, force={"duration_s": 0.1}, iv={"duration_s": 0.1})
    with made.running(tmp_path / "data") as address:
        told = client(
            address,
            """
remote.run("spm.xyscanner.moveTo(0.2, -0.1)")
print(json.dumps({mode: remote.run(f"spm.spect.start('{mode}', 'here')")["result"] for mode in ("fd", "iv")}))
""",
        )
        assert told == {"fd": "Done", "iv": "Done"}
        deadline_s = time.monotonic() + DEADLINE_S
        while len(found := list((tmp_path / "data").glob("*.tiff"))) < 2:
            assert time.monotonic() < deadline_s
            threading.Event().wait(0.05)
    assert sorted(one.name.rpartition("_")[2] for one in found) == ["IV.tiff", "force.tiff"]
    assert made.rig.spectrum is not None
    assert made.rig.spectrum.position_m == pytest.approx((2e-7, -1e-7))


@pytest.mark.parametrize("reads", ["off", "on"])
def test_feedback_is_held_until_after_the_end_of_a_curve(tmp_path: Path, client: Run, reads: str) -> None:
    made = Emulated(seed=2, feedback={"hold_s": 100.0, "hold_reads": reads})
    with made.running(tmp_path / "data", ExperimentClock.starting_now(speed=100.0)) as address:
        told = client(
            address,
            """
before = remote.run("spm.zservo.enable")["value"]
held = remote.run("spm.spect.trigger('iv', 'here'); spm.zservo.enable")["value"]
remote.run("spm.spect.stop()")
after = remote.run("spm.spect.start('iv', 'here'); spm.zservo.enable")["value"]
while (later := remote.run("spm.zservo.enable")["value"]) != before: pass
remote.run("spm.zservo.enable = false")
print(json.dumps({"values": [before, held, after, later, remote.run("spm.zservo.enable")["value"]]}))
""",
        )
    held = "true" if reads == "on" else "false"
    assert told == {"values": ["true", held, held, "true", "false"]}


def test_computation_needs_no_instrument(tmp_path: Path, client: Run) -> None:
    with Emulated(seed=2, values="native").running(tmp_path / "data") as address:
        told = client(address, """print(json.dumps({"sum": remote.run("[1, 2, 3].map(x => x * x)")["value"]}))""")
    assert told == {"sum": [1, 4, 9]}


TAKEN = (
    "chs = spm.scan.channels.names()\nfor (var i = 0; i < chs.length; i++) {\nspm.scan.channels.remove(chs[i]) }",
    "spm.scan.channels.add({'name': 'ChannelZHeight', 'unit': 'um'})",
    "spm.scan.channels.add('ncmamplitude')",
    "spm.scan.channels.remove('ncmamplitude')",
    "spm.addChannel('current')",
    "spm.scan.options = {'twoWay': true, 'sineScan': false, 'overScan': {'enable': true, 'percent': 5}}",
    "spm.scan.rate = 60",
    "spm.zservo.enable = true\nspm.zservo.setpoint.normalized = true",
    "spm.zservo.gain = {'z+': 1, 'z-': 1, 'p': 0.5, 'i': 0.5}\nspm.zservo.setpoint.normValue = 1",
    "spm.zservo.nomalized = false",
    "spm.zservo.setpoint.value",
    "spm.approach.start('q+s')",
    "spm.approach.state",
    "spm.approach.stop()",
    "spm.scan.triggerLineScan()",
    "spm.scan.stop()",
    "spm.zscanner.moveTo(spm.zscanner.fullyRetractedPos)",
    "spm.zscanner.moveTo(5.0, 0.5)",
    "spm.zscanner.pos",
    "spm.zstage.move(10, 0.8)",
    "spm.zstage.moveTo(spm.zstage.pos - 2, 0.5)",
    "spm.zstage.reset()",
    "spm.xystage.moveTo(20, -5, 1, 1)",
    "spm.xystage.reset()",
    "spm.focusstage.moveTo(12, 1)",
    "spm.focusstage.pos",
    "spm.focusstage.reset()",
    "spm.ncm.sweepAuto(25, 10, 1000, 9)",
    "spm.ncm.sweepAutoFullRange()",
    "spm.readChannel('current').value",
    "spm.readChannel('ncmamplitude').unit",
    "spm.readChannel('ncmamplitude').rawValue",
    "spm.readChannelAveraged('ncmamplitude', 10, 5)",
    "spm.sleep(100)",
    "spm.zscanner.retractAll()",
)
"""Lines of users' scripts and wrappers that measure, move, or set what a measurement needs."""

REFUSED = (
    "spm.head.setMode('ncm')",
    "spm.xyservo.mode = 'on'",
    "spm.approach.setOption({'targetPos': 0, 'quickSpeed': 100})",
    "spm.zscanner.changeRangeTo(70)",
    "spm.xyscanner.changeRangeTo(100)",
    "spm.fx.analyzer.autoAlign()",
    "app.save(['a'], 'C:/a.csv')",
)
"""Lines that change the instrument instead: there is nothing that they could change here."""


def test_lines_of_users_scripts_are_carried_out_or_refused(tmp_path: Path, client: Run) -> None:
    made = Emulated(seed=2, errors="result")
    with made.running(tmp_path / "data", ExperimentClock.starting_now(speed=50.0)) as address:
        replies = client(
            address, f"print(json.dumps({{line: remote.send_script(line) for line in {[*TAKEN, *REFUSED]!r}}}))"
        )
    answers = {line: (reply["result"], reply["value"]) for line, reply in replies.items()}  # type: ignore[index]
    assert {line: answers[line] for line in TAKEN if answers[line][0] != "Done"} == {}
    assert {line: answers[line] for line in REFUSED if answers[line][0] != "Error"} == {}
    assert all("Error: " in answers[line][1] for line in REFUSED), "in the words of JavaScript"
    assert answers["spm.zscanner.pos"][1] == "5"
    assert answers["spm.readChannel('ncmamplitude').unit"][1] == "V"
    assert answers["spm.focusstage.pos"][1] == "12"
