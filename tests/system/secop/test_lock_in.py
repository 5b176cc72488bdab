"""An experiment with a generator and a lock-in of a user's own Python: no reading is from before a set."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from deadlines import DEADLINE_S
from tests.plugins.secop.test_secop_server_sample import loaded

import afspm
from afspm.basics.errors import AfspmError

PEAK_GHZ = 15.0
EXPERIMENT = """
[microscope]
component = true
class = "Simulator"

[control]
idle = "stay"

[scheduler]
component = true
class = "Scheduler"

[lab]
component = true
class = "Instrument"
address = "secop://127.0.0.1:PORT"
parameters = { "lab.rf" = "rf", "lab.x" = "lockin" }
"""


class Generator:
    """A generator whose frequency is in force at once, and a lock-in that follows it."""

    def __init__(self) -> None:
        self.ghz = 12.0

    def set(self, ghz: float) -> None:
        self.ghz = ghz

    def get(self) -> float:
        return self.ghz

    def x(self) -> float:
        return math.exp(-((self.ghz - PEAK_GHZ) ** 2))


@contextmanager
def served() -> Iterator[int]:
    """Serve generator and lock-in; yield the port."""
    sample: Any = loaded()
    generator = Generator()
    modules = {
        "rf": sample.Module("generator", "GHz", get=generator.get, set=generator.set),
        "lockin": sample.Module("lock-in", "V", get=generator.x),
    }
    with sample.Server(modules, port=0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


@contextmanager
def running(folder: Path, text: str) -> Iterator[afspm.Scope]:
    """Run an experiment, and end it after the block."""
    (folder / "experiment.toml").write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "afspm", "run", "experiment.toml"]
    with (folder / "run.txt").open("wb") as log:
        run = subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
    until_s = time.monotonic() + DEADLINE_S
    while not list(folder.glob("runs/*/run.json")):
        assert time.monotonic() < until_s, (folder / "run.txt").read_text(encoding="utf-8")
        time.sleep(0.1)
    with afspm.connect(folder / "runs") as made:
        yield made
        made.end_experiment()
    run.wait(DEADLINE_S)


@pytest.fixture
def scope(tmp_path: Path) -> Iterator[afspm.Scope]:
    with served() as port, running(tmp_path, EXPERIMENT.replace("PORT", str(port))) as made:
        yield made


def measured(scope: afspm.Scope, parameter: str) -> float:
    until_s = time.monotonic() + DEADLINE_S
    while True:
        try:
            return float(scope.read(parameter))
        except AfspmError:  # the instrument is not connected yet
            assert time.monotonic() < until_s
            time.sleep(0.1)


def test_every_point_of_a_sweep_is_measured_after_its_set(scope: afspm.Scope) -> None:
    # spectra F7: 7 of 11 readings were the ones of the point before, and the peak stood at 15.4 GHz
    measured(scope, "lab.x")
    ways: dict[str, Callable[[], Any]] = {"get": lambda: scope.get("lab.x"), "read": lambda: scope.read("lab.x")}
    for way, measure in ways.items():
        for wait in (False, True):
            began_s = time.monotonic()
            with scope.control():
                for step in range(11):
                    ghz = 13.0 + 0.4 * step
                    scope.set("lab.rf", ghz, "GHz", wait=wait)
                    assert measure() == pytest.approx(math.exp(-((ghz - PEAK_GHZ) ** 2))), (way, wait, step)
            assert (time.monotonic() - began_s) / 11 < 1.5, (way, wait)  # with a fixed time of 3 s: 3.7 s
    assert 0.0 <= float(scope.get("lab.x.age")) < 4.0
