"""The processes of a measurement, each in one role."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from afspm.basics.clock import ExperimentClock
from afspm.basics.launch import Launch, Sockets
from afspm.storage.packet_log import expect_recorder, log_folder
from afspm.supervisor.ports import FreePorts
from benchmarks.crashes import CrashWatch

CLOCK = ExperimentClock.real()
PORTS = FreePorts()


class Roles(ExitStack):
    """Starts processes, and ends them at the end of the block; raises RuntimeError if one has crashed by then.

    Attributes:
        run_folder: of the scheduler started last; its record, if any, is there.
    """

    def __init__(self) -> None:
        super().__init__()
        self.processes: list[subprocess.Popen[Any]] = []
        self.run_folder = Path()
        self._crashes = CrashWatch()

    def start(self, role: str, **arguments: Any) -> str:
        """Start a process of `benchmarks.roles`; return its line when it is ready."""
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.roles", role, json.dumps(arguments)], stdout=subprocess.PIPE, text=True
        )
        self.processes.append(process)
        self.callback(self._end, process)
        assert process.stdout is not None
        return process.stdout.readline().strip()

    def scheduler(
        self,
        translator_publish: str,
        translator_serve: str,
        *,
        recorded: bool = False,
        class_: str = "afspm.scheduler.Scheduler",
        **settings: Any,
    ) -> tuple[str, str]:
        """Start the real scheduler, which keeps its state on disk; return the addresses (publish, serve).

        Args:
            recorded: start a recorder, too, as in every experiment.
        """
        folder = self.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        self.run_folder = Path(folder)
        publish, serve = PORTS.address(), PORTS.address()
        if recorded:
            expect_recorder(log_folder(Path(folder)))
            sockets = Sockets(subscribe=(publish,), control=serve)
            recorder = "afspm.components.recorder.Recorder"
            line = Launch("recorder", recorder, sockets=sockets, run_dir=folder, state_dir=folder, log_level="ERROR")
            self._host(line)
        launch = Launch(
            "scheduler",
            class_,
            settings,
            sockets=Sockets(publish, (translator_publish,), serve, translator_serve),
            state_dir=folder,
            log_level="ERROR",
        )
        self._host(launch)
        return publish, serve

    def dashboard(self, publish: str, serve: str) -> str:
        """Start the real dashboard of a scheduler; return the address of its page, where it answers in a moment."""
        port = int(PORTS.address().rpartition(":")[2])
        launch = Launch(
            "dashboard",
            "afspm.plugins.web.dashboard.dashboard.Dashboard",
            {"port": port},
            sockets=Sockets(subscribe=(publish,), control=serve),
            envelopes=("",),
            state_dir=self.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)),
            log_level="ERROR",
            simulated=True,
        )
        self._host(launch)
        return f"http://127.0.0.1:{port}"

    def microscope(self, **settings: Any) -> str:
        """Start the real translator of a simulated microscope; return the address of its control server."""
        return self.translator("afspm.simulation.simulator.Simulator", **settings)[1]

    def translator(self, class_: str, **settings: Any) -> tuple[str, str]:
        """Start the real translator of a microscope; return the addresses (publish, serve)."""
        folder = self.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True))
        publish, serve = PORTS.address(), PORTS.address()
        launch = Launch(
            "microscope",
            class_,
            settings,
            sockets=Sockets(publish, serve=serve),
            run_dir=folder,
            state_dir=f"{folder}/state",
            log_level="CRITICAL",
            simulated=True,
        )
        self._host(launch)
        return publish, serve

    def _host(self, launch: Launch) -> None:
        process = subprocess.Popen([sys.executable, "-m", "afspm.supervisor.host"], stdin=subprocess.PIPE)
        self.processes.append(process)
        self.callback(self._end, process)
        assert process.stdin is not None
        process.stdin.write(launch.to_json().encode() + b"\n")
        process.stdin.flush()

    def _end(self, process: subprocess.Popen[Any]) -> None:
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                stream.close()
        crashes = self._crashes.of(process)
        process.kill()
        process.wait()
        if crashes:
            raise RuntimeError(f"a process has crashed: {crashes}")


@contextmanager
def roles() -> Iterator[Roles]:
    with Roles() as started:
        yield started
