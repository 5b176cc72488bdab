"""`Component`: the base class of a scientist's component, with a handler for each kind of message."""

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
    from afspm.model.planned_work import PlannedWork
    from afspm.storage.memory import Memory
    from afspm.transport.process.context import ProcessContext


class Component:
    """One part of an experiment, in its own process.

    Write the handlers you need, and `__init__` with the settings of the experiment file as keyword arguments
    (`super().__init__()` is not needed)::

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

    Everything runs on one thread, one handler at a time. An exception in a handler ends the process; the supervisor
    restarts the process, and the scheduler sends the cached packets again, also packets handled before.

    The attributes below exist from `on_start` on, not yet in `__init__`.

    Attributes:
        scope: the handle for scans, parameters and control.
        clock: the experiment's clock. Never use `time.time()`.
        log: a `logging.Logger`.
        name: name of this component in the experiment file.
        memory: a dict on disk, saved after each handler (in `run`: by its `save`) and restored after a restart.
        run_dir: folder of this run.
        simulated: whether the microscope is simulated; state it in your output.
        packet: the packet of the running handler, with envelope and time; None without a packet.
        longest_step_s: longest allowed duration of a handler in real seconds; after this time the process counts as
            frozen and is killed. Waiting inside `scope` does not count.
        period_s: period of `on_tick` in s; None: no ticks.
        period_time: whether `period_s` is in experiment time or real time.
    """

    solves: ClassVar[tuple[str, ...]] = ()
    """Problems that the component solves."""
    flags: ClassVar[tuple[str, ...]] = ()
    """Problems that the component may flag. Each needs a component that solves it, or an entry in the experiment file:
    `solved_by_hand` or `end_on` in [control]."""
    publishes: ClassVar[tuple[str, ...]] = ()
    """Envelopes that the component publishes itself; if there are any, the component gets an address to publish on."""
    listens: ClassVar[tuple[str, ...] | None] = None
    """Prefixes of the envelopes to subscribe to, unless the experiment file gives them. None: all except messages about
    processes, requests, logs, progress, sweeps and notes; `("",)`: all without exception."""
    operates: ClassVar[bool] = False
    """Whether a person in MANUAL mode uses the microscope through this component. [control] roles may name others."""
    has_people: ClassVar[bool] = False
    """Whether the component acts for people, whose passwords are in its setting `people`."""
    needs_approval: ClassVar[bool] = False
    """Whether the component acts for agents: their commands need the approval of a person."""
    requires: ClassVar[tuple[str, ...]] = ()
    """Packages needed beyond a plain install of afspm, in the notation of `pip install`: `("scikit-learn>=1.4",)`."""
    needs_actions: tuple[str, ...] = ()
    """Actions that the microscope must have."""
    needs_parameters: tuple[str, ...] = ()
    """Parameters that the microscope must have, for `afspm check`; they may depend on the settings of an instance."""

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

    def planned_work(self, speed_m_s: float | None) -> PlannedWork | None:
        """Return the work that the component plans, for `afspm check` and the report; None: no estimate.

        Called after `__init__`, without `on_start`, and only for classes that a package declares as entry points and
        for classes derived from them.

        Args:
            speed_m_s: scan speed at the start, if the experiment file gives it.
        """
        return None

    def try_connection(self) -> str:
        """Connect once to the component's own device, change nothing, and describe the device; "" without a device.

        `afspm doctor` calls it after `__init__`, without `on_start`, and only for classes that a package declares as
        entry points and for classes derived from them.

        Raises:
            AfspmError: the device is not usable; `where` is its address.
        """
        return ""

    def run(self) -> None:
        """Run the experiment as a script; the component is done once this returns. Such a component has no ticks."""

    def on_start(self) -> None:
        """Prepare the component: all attributes exist, and no other handler has been called yet."""

    def on_scan(self, scan: Scan) -> None:
        """Handle one measured channel of a scan."""

    def on_spectrum(self, spectrum: Spectrum) -> None:
        """Handle a measured spectrum."""

    def on_state(self, status: ScopeStatus) -> None:
        """Handle a new state of the microscope."""

    def on_control(self, control_state: ControlState) -> None:
        """Handle a change of mode, holder or problems."""

    def on_problem(self, problem: str, flagged: bool) -> None:
        """Handle a problem that was flagged (`flagged`) or cleared; at the start, each problem already flagged.

        `problem` is a standard name, such as "tip-shape-changed", or a name from the experiment file.
        """

    def on_scan_parameters(self, parameters: ScanParameters) -> None:
        """Handle a new region or shape of the next scan."""

    def on_feedback(self, feedback: Feedback) -> None:
        """Handle a new setting of the z feedback."""

    def on_probe_position(self, position: ProbePosition) -> None:
        """Handle a new position of the probe."""

    def on_message(self, envelope: str, message: Any) -> None:
        """Handle a message of a type that has no handler of its own.

        A method `on_peak_list(self, message)` handles the messages of your type `PeakList`.
        """

    def on_tick(self) -> None:
        """Do periodic work, every `period_s`. Ticks missed during a long step are skipped."""

    def on_end(self) -> None:
        """Finish: the experiment has ended, the process is being stopped, or `run` has returned."""

    def publish(self, message: object, envelope: str | None = None) -> None:
        """Publish an object of `afspm.model` or a message of your own type.

        Args:
            envelope: topic for subscribers; the name of the message by default.

        Raises:
            ConfigError: the component has no address to publish on, or the envelope does not begin with the message's
                name.
            WireError: the envelope begins with no known message's name.
            InvalidValue: `message` is neither a model object nor a message.
        """
        self._publish(message, envelope)

    if not TYPE_CHECKING:  # hidden from type checkers, which should see only the annotated attributes

        def __getattr__(self, name: str) -> Any:
            if name in Component.__annotations__:
                raise AttributeError(
                    f"{type(self).__name__}.{name.lstrip('_')} is not there yet in __init__; use it from on_start on"
                )
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")

    def run_process(self, context: ProcessContext) -> int:
        """Run the component; the host calls this, see `afspm.transport.process.context.ExperimentProcess`."""
        with context.activity.step():  # counts as a part of the start, for which simulated time waits
            from afspm.client.loop import ComponentLoop

            loop = ComponentLoop(self, Component, context)
        return loop.run()
