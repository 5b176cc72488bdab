"""The test bench of a client: a scripted scheduler or a real experiment to which the client connects."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import zmq

from afspm.basics.clock import Clock, ExperimentClock
from afspm.basics.errors import AfspmError, ConfigError
from afspm.basics.launch import Launch, Sockets
from afspm.supervisor import run_identity
from afspm.supervisor.ports import FreePorts
from afspm.testing.clients.experiment import CLIENT, JUDGE, KEYS, SCHEDULER, JudgedExperiment, Security
from afspm.testing.clients.heartbeats import BeatRecorder
from afspm.testing.clients.program import ClientProgram, Pump
from afspm.testing.clients.scripted import ScriptedScheduler
from afspm.testing.conformance import Check, Failed
from afspm.transport import keys
from afspm.transport.network import Network

BEAT_S = 0.5
TOKEN = "only-this-client-knows-it"
LOG_FILE = "client.txt"


@dataclass
class JudgedClient:
    """A started client and the recorder of its heartbeats."""

    program: ClientProgram
    beats: BeatRecorder


@dataclass
class ScriptedRun:
    """A client connected to a scripted scheduler."""

    scheduler: ScriptedScheduler
    client: ClientProgram
    beats: BeatRecorder


class ClientBench:
    """The fixture of the client checks.

    Args:
        command: the conformance program.
        folder: folder for logs and files of the runs.
    """

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        self.command, self.folder = tuple(command), folder
        self.clock: Clock = ExperimentClock.real()
        self._keys = folder / KEYS
        keys.generate(self._keys, (CLIENT, SCHEDULER, JUDGE))
        self._ports = FreePorts()
        self._runs = itertools.count(1)
        self._experiment: JudgedExperiment | None = None

    @property
    def experiment(self) -> JudgedExperiment:
        """A real, encrypted experiment shared by several checks; replaced once it has ended."""
        if self._experiment is not None and self._experiment.ended:
            self.restart_experiment()
        if self._experiment is None:
            self._experiment = self.new_experiment()
        return self._experiment

    def new_experiment(self, security: Security = Security.EVERYWHERE) -> JudgedExperiment:
        """Start a real experiment; the caller must close it."""
        return JudgedExperiment(self.folder / f"run-{next(self._runs)}", security)

    def perform(self, check: Check) -> str | None:
        """Run a check.

        Raises:
            Failed: a failed check, an unreadable answer, or an error in the experiment.
            ConfigError: the conformance program can't be started.
        """
        try:
            remark: str | None = check.do(self)
            return remark
        # the conformance program can't be started: no check is possible
        except ConfigError:
            raise
        except AfspmError as error:  # the judge's own request failed, with this client beside it
            raise Failed("an experiment that goes on with the client in it", str(error)) from error
        # an answer has the wrong type or lacks a field
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise Failed(
                "an answer as the page of steps describes it", f"one that can't be read ({error!r})"
            ) from error

    def explain(self, check: Check, failure: Failed) -> tuple[str, ...]:
        """Return the remedy, and end the shared experiment."""
        self.restart_experiment()
        return (f"→ {check.remedy}",)

    def restart_experiment(self) -> None:
        """End the shared experiment, so that its history does not affect the next check."""
        if self._experiment is not None:
            self._experiment.close()
        self._experiment = None

    def __enter__(self) -> ClientBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.restart_experiment()

    @contextmanager
    def client(self, experiment: JudgedExperiment, *, ready: bool = True, **changes: Any) -> Iterator[JudgedClient]:
        """Start a client in an experiment.

        Args:
            ready: True to wait until the client is ready.
            changes: changes to the client's launch line.
        """
        with self._started(replace(experiment.launch, **changes), experiment.pump, experiment.wake) as client:
            if ready:
                client.program.succeed("ready")
            yield client

    @contextmanager
    def scripted(
        self, *, ready: bool = True, owner: str | None = SCHEDULER, also: str = "", **changes: Any
    ) -> Iterator[ScriptedRun]:
        """Start a client with a scripted scheduler.

        Args:
            ready: True to wait until the client is ready.
            owner: the owner of the scheduler's keys; None: no encryption.
            also: the address of a second publisher, the judge's.
            changes: changes to the client's launch line.
        """
        control, publish = self._ports.address(), self._ports.address()
        launch = replace(self._scripted_launch(control, publish, also), **changes)
        own = None if owner is None else keys.load(self._keys, owner)
        scheduler = ScriptedScheduler(self.clock, control, publish, own)
        with ExitStack() as stack:
            stack.callback(scheduler.close)
            client = stack.enter_context(self._started(launch, scheduler.pump, scheduler.wake))
            if ready:
                client.program.succeed("ready")
            yield ScriptedRun(scheduler, client.program, client.beats)

    @contextmanager
    def second_publisher(self) -> Iterator[tuple[str, Callable[..., object]]]:
        """Bind a second PUB socket, without replay; yield its address and a function that sends frames."""
        network = Network(keys.load(self._keys, JUDGE))
        try:
            socket = network.socket(zmq.PUB)
            yield network.bind(socket, "tcp://127.0.0.1:0"), lambda *frames: socket.send_multipart(frames)
        finally:
            network.close()

    def _scripted_launch(self, control: str, publish: str, also: str) -> Launch:
        own = keys.load(self._keys, CLIENT, {control: SCHEDULER, publish: SCHEDULER, **({also: JUDGE} if also else {})})
        return Launch(
            CLIENT,
            sockets=Sockets(subscribe=(publish, *filter(None, [also])), control=control),
            clock=ExperimentClock.starting_now().as_dict(),
            run_dir=str(self.folder),
            request_timeout_s=1.0,
            request_retries=3,
            keys=own.as_launch(),
            run=run_identity.new_identity(),
            simulated=True,
        )

    @contextmanager
    def _started(self, launch: Launch, pump: Pump, wake: Callable[[], None]) -> Iterator[JudgedClient]:
        with ExitStack() as stack:
            beats = BeatRecorder(self.clock, wake)
            stack.callback(beats.close)
            sockets = replace(launch.sockets, heartbeat=beats.address)
            complete = replace(launch, sockets=sockets, beat_period_s=BEAT_S, beat_token=TOKEN)
            program = ClientProgram(self.command, complete, pump, wake, self.folder / LOG_FILE)
            stack.callback(program.kill)
            yield JudgedClient(program, beats)
            program.require_clean_output()
