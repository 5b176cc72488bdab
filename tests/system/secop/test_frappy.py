"""An experiment with the simulated cryostat and magnet of frappy, a SECoP server."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest
from deadlines import DEADLINE_S
from systems import not_on_wine

import afspm
from afspm.basics.errors import AfspmError, Refused
from afspm.record.run_json import RUN_FILE

pytest.importorskip("frappy_demo")
pytestmark = [not_on_wine("frappy's server needs a POSIX system")]
SERVER = """
# frappy's simulated cryostat and magnet, fast enough for a test
Node("cryomagnet.afspm", "a simulated cryostat and magnet", "tcp://0")
Mod(
    "tt", "frappy_demo.cryo.Cryostat", "cryostat",
    jitter=0.001, T_start=4.2, target=4.2, looptime=0.2, ramp=1, maxpower=20.0, heater=0.0, mode="pid",
    tolerance=0.1, window=1, timeout=900, p=40, i=10, d=2,
)
Mod("sw", "frappy_demo.modules.Switch", "heat switch", switch_on_time=1, switch_off_time=1)
Mod("mf", "frappy_demo.modules.MagneticField", "magnet", heatswitch="sw")
"""
EXPERIMENT = """
[microscope]
component = true
class = "Simulator"
seed = 1
initial = { scan-speed = "20 um/s" }

[control]
idle = "stay"

[scheduler]
component = true
class = "Scheduler"

[cryo]
component = true
class = "Instrument"
address = "secop://127.0.0.1:PORT"
parameters = {{ "cryo.temperature" = "tt", "cryo.field" = "mf" }}

[limits."cryo.temperature"]
max = "300 K"
rate = "120 K/min"

[limits."cryo.field"]
rate = "1 T/min"

[problems]
no-field = 100

[conditions.field]
"cryo.field" = { within = "2 mT", for = "1 s" }
"cryo.temperature" = { from = "1 K", to = "50 K" }
problem = "no-field"
""".replace("{{", "{").replace("}}", "}")


class Server:
    """A frappy server as a process of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / "cryomagnet_cfg.py").write_text(SERVER, encoding="utf-8")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.start()

    def start(self) -> None:
        folders = {"FRAPPY_CONFDIR": self.folder, "FRAPPY_LOGDIR": self.folder, "FRAPPY_PIDDIR": self.folder}
        environment = {**os.environ, **{name: str(path) for name, path in folders.items()}}
        program = Path(sys.executable).with_name("frappy-server")
        with (self.folder / "frappy.txt").open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, program, "-q", "-p", str(self.port), "cryomagnet"],
                env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    made = Server(tmp_path)
    yield made
    made.kill()


def devices(folder: Path) -> tuple[int, list[dict[str, str]]]:
    """Return the exit code of `afspm doctor`, and its findings about devices."""
    command = [sys.executable, "-P", "-m", "afspm", "doctor", "experiment.toml", "--json", "--listen", "0.1"]
    done = subprocess.run(command, cwd=folder, capture_output=True, encoding="utf-8", timeout=DEADLINE_S)
    return done.returncode, [one for one in json.loads(done.stdout)["found"] if one["code"] == "device"]


def test_doctor_tries_the_server_of_an_instrument(server: Server, tmp_path: Path) -> None:
    file, where = tmp_path / "experiment.toml", f"127.0.0.1:{server.port}"
    experiment = EXPERIMENT.replace("PORT", str(server.port))
    file.write_text(experiment, encoding="utf-8")
    wait_until(lambda: devices(tmp_path)[1][0]["severity"] == "fine")
    _, (found,) = devices(tmp_path)
    assert found["where"] == "cryo"
    assert found["what"] == f"{where} is the SECoP server cryomagnet.afspm, and has cryo.temperature, cryo.field"

    file.write_text(experiment.replace('= "mf"', '= "magnet"'), encoding="utf-8")
    code, (found,) = devices(tmp_path)
    assert (code, found["where"]) == (1, f"cryo at {where}")
    assert found["what"] == "there is no module 'magnet'; the server has mf, sw, tt"

    file.write_text(experiment, encoding="utf-8")
    server.kill()
    code, (found,) = devices(tmp_path)
    assert (code, found["severity"], found["where"]) == (1, "error", f"cryo at {where}")
    assert "no SECoP server answers" in found["what"]
    assert "start the server" in found["remedy"]


@pytest.fixture
def folder(server: Server, tmp_path: Path) -> Iterator[Path]:
    """The folder of a running experiment."""
    (tmp_path / "experiment.toml").write_text(EXPERIMENT.replace("PORT", str(server.port)), encoding="utf-8")
    command = [sys.executable, "-m", "afspm", "run", "experiment.toml"]
    with (tmp_path / "run.txt").open("wb") as log:
        run = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    yield tmp_path
    run.terminate()
    try:
        run.wait(DEADLINE_S)
    except subprocess.TimeoutExpired:
        run.kill()


def wait_until(holds: object) -> None:
    assert callable(holds)
    until_s = time.monotonic() + DEADLINE_S
    while not holds():
        assert time.monotonic() < until_s, "waited in vain"
        time.sleep(0.1)


def has_reported(scope: afspm.Scope) -> bool:
    try:
        scope.get("cryo.temperature")
    except AfspmError:
        return False
    return True


def sets_field(scope: afspm.Scope) -> bool:
    """Ramp the magnet to 60 mT; False if its reading is late, as on a busy computer: then nothing may be set."""
    try:
        found = scope.set("cryo.field", "60 mT", wait=True, timeout_s=DEADLINE_S)
    except Refused as refused:
        if "value is not known" in str(refused):
            return False
        raise
    assert found == pytest.approx(60, abs=2)  # the magnet rounds to 10 mT, and ramps at 1 T/min
    return True


def test_cryostat_and_magnet_are_set_flagged_and_recorded(server: Server, folder: Path) -> None:
    wait_until(lambda: list(folder.glob(f"runs/*/{RUN_FILE}")))
    with afspm.connect(folder / "runs") as scope:
        no_field = scope.problems["no-field"]
        # flagged at the start if the first reading takes longer than 4 s, which may be over already
        wait_until(lambda: has_reported(scope))
        wait_until(lambda: not scope.control_state.problems)
        assert scope.get("cryo.temperature") == pytest.approx(4.2, abs=3.0)
        wait_until(lambda: sets_field(scope))
        with pytest.raises(Refused, match="above the highest allowed, 300 K"):
            scope.set("cryo.temperature", "301 K")
        with pytest.raises(Refused, match="has no unit"):
            scope.set("cryo.temperature", 5.0)
        wait_until(lambda: not scope.control_state.problems)
        scope.scan(timeout_s=DEADLINE_S)
        server.kill()
        wait_until(lambda: no_field in scope.control_state.problems)
        server.start()
        wait_until(lambda: not scope.control_state.problems)
        scope.end_experiment()
    (run,) = [one for one in folder.glob("runs/*") if not one.is_symlink()]
    wait_until(lambda: list((run / "scans").glob("*.h5")))
    files = sorted((run / "scans").glob("*.h5"))
    with h5py.File(files[0]) as file:
        sample = file["entry/sample"]
        assert sample["magnetic_field"][()] == pytest.approx(0.06, abs=0.002)
        assert sample["magnetic_field"].attrs["units"] == "T"
        sensor = sample["environment/cryo_temperature"]
        assert sensor["value"][()] == sample["temperature"][()]
        assert 0.0 < sensor["value_age"][()] < 10.0
