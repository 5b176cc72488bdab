"""A dashboard and a stand-in for the scheduler: everything on the page is published by the caller, at its time."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.model import ControlMode, ControlState, Region, Scan, ScopeState, ScopeStatus
from afspm.transport.zmq_port import open_port

REGION = Region((0.0, 0.0), (1e-6, 1e-6))


class Stage(ExitStack):
    """Publishes as a scheduler does, in real time, to a real dashboard.

    Attributes:
        url: of the dashboard.
        process: the dashboard.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__()
        self.clock = ExperimentClock.real()
        launch = Launch("scheduler", sockets=Sockets(publish="tcp://127.0.0.1:0"))
        self._port = open_port(launch, self.clock)
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._server = threading.Thread(target=self._serve, daemon=True)
        self._folder = Path(self.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
        self._settings = settings

    def __enter__(self) -> Self:
        self._server.start()
        address = self._port.publish_address
        assert address is not None
        launch = Launch(
            "dashboard",
            "afspm.plugins.web.dashboard.dashboard.Dashboard",
            {"port": 0, **self._settings},
            sockets=Sockets(subscribe=(address,)),
            envelopes=("",),
            clock=self.clock.as_dict(),
            state_dir=str(self._folder),
            simulated=True,
        )
        self.process = subprocess.Popen(
            (sys.executable, "-m", "afspm.supervisor.host"), stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self.process.stdin is not None
        assert self.process.stderr is not None
        self.process.stdin.write(launch.to_json() + "\n")
        self.process.stdin.flush()
        self.callback(self._end)
        lines = []
        for line in self.process.stderr:
            lines.append(line)
            if "the dashboard is at " in line:
                self.url = line.split()[-1]
                break
        else:
            raise RuntimeError("the dashboard did not start:\n" + "".join(lines))
        self.publish(ControlState(ControlMode.AUTOMATED, "series"))
        self.publish(ScopeStatus(ScopeState.FREE))
        return super().__enter__()

    def publish(self, thing: Any, envelope: str = "") -> None:
        """Publish an object of the model."""
        message, payload = wire.encode(thing)
        with self._lock:
            self._port.publish(envelope or message, payload)

    def scan(self, values: NDArray[np.float64], channel: str = "Height") -> int:
        """Publish a scan; returns its time, which is now."""
        now_ns = self.clock.now_ns()
        scan = Scan(REGION, channel, "m", values, now_ns)
        message, payload = wire.encode(replace(scan, time_ns=now_ns))
        with self._lock:
            self._port.publish(f"{message}_{channel}", payload)
        return now_ns

    def memory_bytes(self) -> int:
        """Return the dashboard's resident memory."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="utf-8")
        line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
        return int(line.split()[1]) * 1024

    def _serve(self) -> None:
        # answers new subscribers
        while not self._over.is_set():
            with self._lock:
                self._port.poll(0.0)
            self._over.wait(0.002)

    def _end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        assert self.process.stderr is not None
        self.process.stderr.close()
        self._over.set()
        self._server.join()
        self._port.close()


def picture(side: int, seed: int = 0) -> NDArray[np.float64]:
    """Return values as incompressible as those of a real scan."""
    rng = np.random.default_rng(seed)
    rough = rng.normal(size=(side, side)).cumsum(axis=1)
    return np.asarray(1e-10 * (rough - np.linspace(0, 1, side)[None, :] * rough[:, -1:]))
