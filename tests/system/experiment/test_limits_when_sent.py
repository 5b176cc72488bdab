"""Requests sent without waiting for answers, through real processes: the tip stays in `[limits] region`."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from afspm_process import AFSPM
from deadlines import DEADLINE_S
from makers import MAKERS

from afspm.model import ControlResponse

FILES = Path(__file__).parents[3] / "experiments" / "every_microscope"
LIMITED = """
[details]
component = false

[metadata]
component = false

[burst]
component = true
command = ["python", "SCRIPT"]
heartbeats = false

[limits]
region = { x = ["-3 um", "3 um"], y = ["-3 um", "3 um"] }

[security]
insecure = true
"""
BURST = '''
"""Widens the frame, moves it, and scans, without waiting for answers. Each of the first two fits by itself."""

import json
import sys
from pathlib import Path

import zmq

from afspm import wire
from afspm.model import ControlRequest, Parameter, Region, Request, ScanParameters

launch = json.loads(sys.stdin.readline())
socket = zmq.Context().socket(zmq.DEALER)
socket.setsockopt(zmq.ROUTING_ID, launch["name"].encode())
socket.connect(launch["sockets"]["control"])
asked, answers = 0, {}


def send(kind, subject):
    global asked
    asked += 1
    id_ = f"{launch['name']}/life/{asked}"
    socket.send_multipart([b"", *wire.encode_request(Request(int(kind), subject, id=id_))])
    return id_


def wait_for(id_):
    while id_ not in answers:
        _, *frames = socket.recv_multipart()
        if frames != [b""]:
            response = wire.decode_response(frames)
            answers[response.id] = response
    return answers[id_]


def ask(kind, subject, is_enough=lambda answer: answer.ok):
    while not is_enough(answer := wait_for(send(kind, subject))):
        pass
    return answer


def read(name):
    value = wire.decode("ParameterMsg", ask(ControlRequest.PARAM, Parameter(name)).payload)
    return float(value.value), value.unit


ask(ControlRequest.ACTION_SUPPORT, "start-scan")
ask(ControlRequest.REQUEST_CTRL, 0)
ask(ControlRequest.SET_SCAN_PARAMS, ScanParameters(Region((0.0, 0.0), (1e-6, 1e-6)), (16, 16)))
burst = [
    send(ControlRequest.PARAM, Parameter("scan-size-x", "3.4", "um")),
    send(ControlRequest.PARAM, Parameter("scan-top-left-x", "1.9", "um")),
    send(ControlRequest.ACTION, "start-scan"),
]
found = [(int(answer.code), answer.reason) for answer in map(wait_for, burst)]
places = [read("scan-top-left-x"), read("scan-size-x")]
Path(launch["run_dir"], "burst.json").write_text(json.dumps({"answers": found, "places": places}))
ask(ControlRequest.END_EXPERIMENT, None)
sys.stdin.read()
'''


@pytest.mark.parametrize("microscope", ["simulator", *sorted(MAKERS)])
def test_burst_of_requests_stays_in_the_region(microscope: str, tmp_path: Path) -> None:
    overlay, script = tmp_path / "overlay.toml", tmp_path / "burst.py"
    overlay.write_text(LIMITED.replace("SCRIPT", script.as_posix()), encoding="utf-8")
    script.write_text(BURST, encoding="utf-8")
    second = FILES / "simulator.toml" if microscope == "simulator" else MAKERS[microscope].emulated
    files = [str(FILES / "experiment.toml"), str(second), str(overlay)]
    done = subprocess.run(
        [*AFSPM, "run", *files, "--runs", str(tmp_path / "runs"), "--no-report"],
        capture_output=True,
        encoding="utf-8",
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    (told,) = (tmp_path / "runs").glob("*-*/burst.json")
    found = json.loads(told.read_text(encoding="utf-8"))
    (wider, _), (moved, why), (started, _) = found["answers"]
    assert (wider, moved) == (ControlResponse.SUCCESS, ControlResponse.PARAM_ERROR)
    assert "outside the region" in why
    assert started == ControlResponse.SUCCESS
    (left, left_unit), (width, width_unit) = found["places"]
    assert (left_unit, width_unit) == ("m", "m")
    assert left == pytest.approx(-0.5e-6, abs=5e-9)
    assert width == pytest.approx(3.4e-6, rel=1e-2)
