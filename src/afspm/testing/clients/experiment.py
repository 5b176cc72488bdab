"""A real experiment for checks of a client: scheduler, translator, simulated microscope and the judge."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from enum import Enum
from pathlib import Path

from afspm.basics.clock import Clock
from afspm.basics.errors import ExperimentEnded
from afspm.client.component import Component
from afspm.client.experiment_link import ExperimentLink
from afspm.client.scope import Scope
from afspm.experiment import load
from afspm.model import Packet
from afspm.record.run_json import STATE_DIR
from afspm.supervisor import run_identity
from afspm.supervisor.key_handout import hand_over
from afspm.supervisor.log import RunLog
from afspm.supervisor.ports import FreePorts
from afspm.testing.conformance import Lost
from afspm.testing.processes import Processes
from afspm.transport import keys
from afspm.transport.process.context import new_session
from afspm.transport.zmq_port import open_port

CLIENT, JUDGE, SCHEDULER, TRANSLATOR = "client", "judge", "scheduler", "microscope"
PROCESSES = (CLIENT, JUDGE, SCHEDULER, TRANSLATOR)
KEYS = "keys"
SPEED = 30.0
"""Experiment seconds in a real second."""
STARTED_S = 20.0
_EXPERIMENT = f"""
name = "conformance"

[clock]
speed = {SPEED}

[{TRANSLATOR}]
component = true
class = "Simulator"
seed = 5
surface = "particles"
live_lines_s = 0
initial = {{ scan-speed = "4 um/s" }}

[{SCHEDULER}]
component = true
class = "Scheduler"

[{CLIENT}]
component = true
command = ["python"]

[{JUDGE}]
component = true
class = "{__name__}.Judge"
envelopes = [""]

[control]
grace = "20 s"

[limits.tip-bias-voltage]
max = "3 V"
"""


class Security(Enum):
    """The kinds of encryption of an experiment; each is a section of the experiment file."""

    EVERYWHERE = f'[security]\nkeys = "{KEYS}"\n'
    REQUESTS = ""
    """The default on one computer: requests are encrypted with keys generated for the run, packets are plain."""
    NONE = "[security]\ninsecure = true\n"


_NOTHING = logging.CRITICAL + 1


class Judge(Component):
    """The judge's component in the experiment, wired like any component, but not started as a process."""


class JudgedExperiment:
    """A running experiment.

    Args:
        folder: the folder of this run.
        security: the kind of encryption.

    Attributes:
        launch: the client's launch line; the caller adds the heartbeat's address.
        scope: the judge's connection to the microscope.
        clock: the clock of the experiment.
        seen: every packet that the scheduler has published since the judge joined.

    Raises:
        Lost: the experiment does not start.
    """

    def __init__(self, folder: Path, security: Security) -> None:
        self.folder = folder
        (folder / STATE_DIR).mkdir(parents=True)
        if security is Security.EVERYWHERE:
            keys.generate(folder / KEYS, PROCESSES)
        file = folder / "experiment.toml"
        file.write_text(_EXPERIMENT + security.value, encoding="utf-8")
        experiment = load(file)
        clock = experiment.clock()
        launches = experiment.launches(
            take_address=FreePorts().address,
            without=[name for name in experiment.component_names if name not in PROCESSES],
            clock=clock.as_dict(),
            run=run_identity.new_identity(),
            simulated=True,
            run_dir=str(folder),
            state_dir=str(folder / STATE_DIR),
        )
        starts = {start.launch.name: start for start in hand_over(experiment, launches).starts}
        self.launch = starts[CLIENT].launch
        self.clock: Clock = clock
        self._woken = threading.Condition()
        own = starts[JUDGE].launch
        self._port = open_port(own, clock)
        log = logging.Logger("afspm.judge")
        self._link = ExperimentLink.of_launch(own, self._port, new_session(own.run), log=log)
        self.seen: list[Packet] = []
        self._link.listen(lambda packet, _: self.seen.append(packet))
        self.scope = Scope(self._link)
        self._log = RunLog(folder / "log.txt", clock, level=_NOTHING, names=[SCHEDULER, TRANSLATOR])
        self.processes = Processes(self._log, clock, self.wake, [])
        self.processes.start([starts[TRANSLATOR], starts[SCHEDULER]])
        view = self._link.view
        if not self.pump(lambda: view.status is not None and view.control is not None, STARTED_S):
            self.close()
            raise Lost(f"the experiment does not start: {self.processes.errors or self.processes.ended}")

    @property
    def ended(self) -> bool:
        """True if the experiment can't be used for another check."""
        return self._link.ended or bool(self.processes.ended)

    def pump(self, done: Callable[[], bool], within_s: float) -> bool:
        """Process publications until `done()`; return False on a timeout."""
        try:
            return self._link.wait(done, self._link.until(within_s))
        # the link is over, but the client still has to end: its threads notify `_woken`
        except ExperimentEnded:
            with self._woken:
                return self._woken.wait_for(done, within_s)

    def wake(self) -> None:
        """Make `pump` evaluate its condition again. Thread-safe."""
        self._port.wake_up()
        with self._woken:
            self._woken.notify_all()

    def packets(self, message: str) -> list[Packet]:
        """Return all published packets of a message."""
        return [packet for packet in self.seen if packet.envelope.split("_", 1)[0] == message]

    def restart(self, name: str) -> None:
        """Kill a process as in a crash, and start it again."""
        self.processes.kill(name)
        self.processes.start_again(name)

    def close(self) -> None:
        self._port.close()
        self.processes.close()
        self._log.close()
