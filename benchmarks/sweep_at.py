"""A sweep of an instrument at a place: afspm beside a plain script, at the same SECoP server in another process.

Both set a generator, wait until its module says that it is idle, and let a lock-in measure. afspm runs as a whole:
supervisor, scheduler, translator, instrument, recorder and `SweepAt`. A point is the time of a sweep by its points.
"""

from __future__ import annotations

import contextlib
import json
import socket
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import afspm
from benchmarks.effort import effort
from benchmarks.rows import Row, measurement

POINTS, SWEEPS = effort(101, 5), effort(3, 1)
MORE_THAN_THE_SCRIPT_MS = 100.0
DEADLINE_S = 300.0
SAMPLE = Path(__file__).parents[1] / "experiments" / "serve_as_secop"
SERVER = """
from secop_server import Module, Server

at = [12.0]
modules = {"rf": Module("generator", "GHz", get=lambda: at[0], set=lambda ghz: at.__setitem__(0, ghz)),
           "lockin": Module("lock-in", "V", get=lambda: 1.0 / (1.0 + (at[0] - 15.0) ** 2))}
with Server(modules, port=0) as server:
    print(server.server_address[1], flush=True)
    server.serve_forever()
"""
EXPERIMENT = """
[microscope]
component = true
class = "Simulator"

[scheduler]
component = true
class = "Scheduler"

[lab]
component = true
class = "Instrument"
address = "secop://127.0.0.1:{port}"
parameters = {{ "lab.rf" = "rf", "lab.x" = "lockin" }}

[esr]
component = true
class = "SweepAt"
parameter = "lab.rf"
values = {{ from = "13 GHz", to = "17 GHz", points = {points} }}
read = ["lab.x"]
positions = [["0 nm", "0 nm"]]
repeats = {sweeps}
end_when_done = true
"""


@contextlib.contextmanager
def server() -> Iterator[int]:
    with subprocess.Popen([sys.executable, "-c", SERVER], cwd=SAMPLE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield int(process.stdout.readline())
        process.terminate()


def script_s(port: int) -> float:
    """Return the time of one sweep by a script of one connection."""
    with socket.create_connection(("127.0.0.1", port)) as connection, connection.makefile("rw") as lines:

        def ask(line: str) -> object:
            lines.write(f"{line}\n")
            lines.flush()
            return json.loads(lines.readline().split(" ", 2)[2])[0]

        began_s = perf_counter()
        for number in range(POINTS):
            ask(f"change rf:target {13.0 + 4.0 * number / (POINTS - 1)}")
            while ask("read rf:status")[0] != 100:  # type: ignore[index]
                pass
            ask("read lockin:value")
        return perf_counter() - began_s


def afspm_s(port: int) -> list[float]:
    """Return the time of each sweep, as the record has it."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        file = Path(folder) / "experiment.toml"
        file.write_text(EXPERIMENT.format(port=port, points=POINTS, sweeps=SWEEPS), encoding="utf-8")
        run = subprocess.run(
            [sys.executable, "-m", "afspm", "run", str(file), "--runs", folder, "--no-report"],
            capture_output=True, encoding="utf-8", timeout=DEADLINE_S, check=False,
        )  # fmt: skip
        if run.returncode:
            raise RuntimeError(run.stdout + run.stderr)
        with afspm.open_run(folder) as record:
            return [1e-9 * (row.time_ns - (row.began_ns or 0)) for row in record.spectra]


@measurement
def sweep_at_a_place() -> Iterator[Row]:
    with server() as port:
        bare_ms = statistics.median(script_s(port) for _ in range(SWEEPS)) / POINTS * 1e3
        ours_ms = statistics.median(afspm_s(port)) / POINTS * 1e3
    target = 1.0 + MORE_THAN_THE_SCRIPT_MS / bare_ms
    yield Row("a point of a sweep of an instrument", "ms", ours_ms, bare_ms, target)
