"""`Component`: the class that a scientist derives from, with a handler for each kind of message."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

if TYPE_CHECKING:
    from afspm.basics.clock import Clock
    from afspm.client.scope import Scope
    from afspm.model import (
        ControlState,
        Feedback,
        Packet,
        ProbePosition,
        Scan,
        ScanParameters,
        ScopeStatus,
        Spectrum,
    )
    from afspm.storage.memory import Memory
    from afspm.transport.process.context import ProcessContext


class Component:
    """One part of an experiment, in a process of its own.

    Write the handlers you need, and `__init__` with the settings of the experiment file as keyword arguments
    (`super().__init__()` need not be called)::

        class Sharpness(Component):
            def __init__(self, threshold: float = 0.5):
                self.threshold = threshold

            def on_scan(self, scan):
                if sharpness(scan.values) < self.threshold:
                    self.scope.flag("tip-shape-changed")

    Or write `run` instead, a plain script that may block as long as it likes::

        class Tiles(Component):
            def run(self):
                for i, region in enumerate(self.regions):
                    scans = self.scope.scan(region, shape=(256, 256), key=f"tile-{i}")

    Everything happens on one thread, one handler at a time. A handler that raises ends the process; the supervisor
    starts it again and the scheduler sends it what it has cached.

    The attributes below are given before `on_start`; they are not there yet in `__init__`.

    Attributes:
        scope: to ask for things: scans, parameters, control.
        clock: the time in the experiment. Never use `time.time()`.
        log: a `logging.Logger`.
        name: of this component in the experiment file.
        memory: a dict kept on disk, written when a handler has returned (in `run`: by its `save`): it is there again
            after a restart.
        run_dir: the folder of this run.
        simulated: whether the microscope is a simulated one; say so in what you write.
        packet: the packet that is being handled (its envelope, its time), None between handlers.
        longest_step_s: how long a handler may take in real seconds before the process counts as frozen and is
            killed. Waiting inside `scope` does not count.
        period_s: how often `on_tick` is called; None: never.
        period_time: whether that is experiment time or real time.
    """

    solves: ClassVar[tuple[str, ...]] = ()
    """Problems that it puts right."""
    flags: ClassVar[tuple[str, ...]] = ()
    """Problems that it may flag; the experiment file must have somebody who solves each."""
    publishes: ClassVar[tuple[str, ...]] = ()
    """Envelopes that it publishes itself: it then gets an address to do so."""
    listens: ClassVar[tuple[str, ...] | None] = None
    """Envelopes, or how they begin, that it subscribes to where the experiment file doesn't say. None: all but what is
    told of processes, requests and logs; `("",)`: that too."""
    operates: ClassVar[bool] = False
    """A person commands the microscope by it in MANUAL mode, where the experiment file names nobody else."""
    has_people: ClassVar[bool] = False
    """It acts for persons, whose passwords are in its setting `people`."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Packages that it needs beside a plain install of afspm, as for `pip install`: `("scikit-learn>=1.4",)`."""
    needs_actions: tuple[str, ...] = ()
    """Actions that the microscope must have."""
    needs_parameters: tuple[str, ...] = ()
    """Parameters that the microscope must have. `afspm check` looks; a ready-made one may say so by its settings."""

    longest_step_s: ClassVar[float] = 30.0
    period_s: float | None = None
    period_time: Literal["experiment", "real"] = "experiment"

    scope: Scope
    clock: Clock
    log: logging.Logger
    name: str
    memory: Memory
    run_dir: Path
    simulated: bool
    packet: Packet | None
    _publish: Callable[[Any, str | None], None]

    def run(self) -> None:
        """The experiment as a script; when it returns, the component is done. Not to be combined with ticks."""

    def on_start(self) -> None:
        """Before anything else; all attributes are there."""

    def on_scan(self, scan: Scan) -> None:
        """One channel of a scan was measured."""

    def on_spectrum(self, spectrum: Spectrum) -> None:
        """A spectrum was measured."""

    def on_state(self, status: ScopeStatus) -> None:
        """The microscope does something else now."""

    def on_control(self, control_state: ControlState) -> None:
        """Mode, holder or problems have changed."""

    def on_problem(self, problem: str, flagged: bool) -> None:
        """A problem was flagged (True) or removed (False). At the start, for each that is flagged already.

        `problem` is its name, such as "tip-shape-changed", or one named in the experiment file.
        """

    def on_scan_parameters(self, parameters: ScanParameters) -> None:
        """Where and how the next scan will be taken has changed."""

    def on_feedback(self, feedback: Feedback) -> None:
        """The z feedback was set."""

    def on_probe_position(self, position: ProbePosition) -> None:
        """The probe was moved."""

    def on_message(self, envelope: str, message: Any) -> None:
        """Any other message, for which there is no handler by its name.

        A method `on_peak_list(self, message)` gets the messages of a type `PeakList` of your own.
        """

    def on_tick(self) -> None:
        """Called every `period_s`. A tick that was missed in a long step is not made up for."""

    def on_end(self) -> None:
        """The last call: the experiment ended, we were asked to stop, or `run` has returned."""

    def publish(self, message: Any, envelope: str | None = None) -> None:
        """Publish an object of `afspm.model` or a message of your own type.

        Args:
            envelope: how others subscribe to it; the name of the message by default.

        Raises:
            ConfigError: the component has no address to publish on.
        """
        self._publish(message, envelope)

    if not TYPE_CHECKING:  # for the type checker the annotations above are all there is

        def __getattr__(self, name: str) -> Any:
            if name in Component.__annotations__:
                raise AttributeError(
                    f"{type(self).__name__}.{name.lstrip('_')} is not there yet in __init__; use it from on_start on"
                )
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")

    def run_process(self, context: ProcessContext) -> int:
        """Called by the host; see `afspm.transport.process.context.ExperimentProcess`."""
        from afspm.client.loop import ComponentLoop

        return ComponentLoop(self, Component, context).run()
