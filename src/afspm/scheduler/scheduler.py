"""`Scheduler`: the process of the scheduler, with its settings, its files and its sockets."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from afspm.basics import named_imports
from afspm.basics.errors import ConfigError, FileError, InvalidValue
from afspm.basics.exit_codes import ExitCode
from afspm.model.snapshot import from_plain
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.publishing.envelopes import CacheSettings, EnvelopeMapping, Envelopes
from afspm.scheduler.safety.limits import ExperimentLimits
from afspm.scheduler.settings import ControlSettings, RunFacts, SchedulerSettings

if TYPE_CHECKING:
    from afspm.scheduler.coordinate_frame import CoordinateFrame
    from afspm.scheduler.scheduler_core import SchedulerCore
    from afspm.scheduler.shell import FrameWorker
    from afspm.scheduler.write_ahead import StateFile
    from afspm.transport.process.context import ProcessContext

T = TypeVar("T")


@dataclass(frozen=True)
class Coordinates:
    """The coordinate frame of a scheduler.

    Attributes:
        frame: the frame at a first start.
        worker: the worker for the frame's jobs; None: the frame has no jobs.
    """

    frame: CoordinateFrame
    worker: FrameWorker | None = None


class Scheduler:
    """The arbiter that lets one component at a time command the microscope, and republishes all packets.

    A restarted scheduler continues the run. Mode, holder, problems and packets are on disk before they are published.

    Args:
        control: the section [control] of the experiment file: `ControlSettings` as plain data.
        limits: the section [limits]: `ExperimentLimits`.
        cache: the section [cache]: `CacheSettings`.
        conditions: the section [conditions], and the names of the instruments: `InstrumentSettings`.

    Raises:
        ConfigError: a setting is unknown, or can't be used.
    """

    def __init__(
        self,
        control: Mapping[str, object] | None = None,
        limits: Mapping[str, object] | None = None,
        cache: Mapping[str, object] | None = None,
        conditions: Mapping[str, object] | None = None,
    ) -> None:
        self._control = _section(ControlSettings, control or {}, "control")
        self._limits = _section(ExperimentLimits, limits or {}, "limits")
        self._cache = _section(CacheSettings, cache or {}, "cache")
        self._instruments = _section(InstrumentSettings, conditions or {}, "conditions")

    def run_process(self, context: ProcessContext) -> int:
        """Run the scheduler; return ENDED after the end of the experiment, ORPHAN if the process was stopped before.

        Raises:
            AfspmError: an address, a setting or the saved state can't be used.
        """
        # imported late: to check an experiment file, only the settings are needed, and 60 modules less
        from afspm import wire
        from afspm.scheduler.scheduler_core import SchedulerCore
        from afspm.scheduler.shell import SchedulerShell
        from afspm.scheduler.step_log import RecordedCore, StepLog
        from afspm.scheduler.wire_codec import WireCodec
        from afspm.scheduler.write_ahead import StateFile, WriteAhead
        from afspm.storage import log_folder
        from afspm.storage.packet_log import PacketLog
        from afspm.transport import milliseconds
        from afspm.transport.rate_limited_log import RateLimitedLog
        from afspm.transport.scheduler_sockets import SchedulerSockets

        launch, clock, log = context.launch, context.clock, context.log
        folder = Path(launch.state_dir) if launch.state_dir else None
        state = StateFile(folder and folder / f"{launch.name}.json", log)
        coordinates = self.coordinates(context)
        parts = (self.settings(context), WireCodec(), coordinates.frame)
        keep = StepLog.of_run(launch, log).keep if launch.keeps_requests else None
        core = SchedulerCore(*parts) if keep is None else RecordedCore(*parts, keep=keep)
        _restore(core, state, log_folder(folder) if folder else None)
        write_ahead = WriteAhead(state, PacketLog(log_folder(folder)) if folder else None, core.cached, log)
        warnings = RateLimitedLog(log, clock)
        sockets = SchedulerSockets(launch, warnings, clock, since_ns=core.newest_source_ns, epoch=_epoch(context))
        stopping = threading.Event()

        def stop() -> None:
            stopping.set()
            sockets.wake_up()

        context.when_stopping(stop)
        shell = SchedulerShell(core, sockets, wire, clock, write_ahead, warnings, log, coordinates.worker)
        try:
            shell.start()
            while not (shell.over or stopping.is_set()):
                timeout_s = shell.due_s - clock.monotonic_s()
                ready = sockets.wait(None if timeout_s == math.inf else milliseconds(timeout_s))
                with context.activity.step():
                    shell.handle(ready)
            shell.stop()
        finally:
            sockets.close()
            shell.close()
        return ExitCode.ENDED if shell.ended else ExitCode.ORPHAN

    def settings(self, context: ProcessContext) -> SchedulerSettings:
        """Return the settings of the core.

        Raises:
            ConfigError: [control] end_on names an unknown problem, or the mapping of [cache] can't be loaded.
        """
        from afspm.transport.probe import versions_here

        launch, control, cache = context.launch, self._control, self._cache
        try:
            rules = control.rules(context.problems)
        except InvalidValue as error:
            raise ConfigError(error.what, where="[control] end_on", hint=error.hint) from error
        return SchedulerSettings(
            control=replace(control, request_timeout_s=launch.request_timeout_s),
            rules=rules,
            watchdog=control.watchdog(),
            limits=self._limits,
            instruments=self._instruments,
            envelopes=Envelopes(cache.rules, _mapping(cache.mapping) if cache.mapping else None, cache.history),
            run=RunFacts(dict(launch.clock), launch.run, launch.simulated, asdict(versions_here())),
        )

    def coordinates(self, context: ProcessContext, *, in_process: bool = False) -> Coordinates:
        """Return the coordinate frame of components: the tip's, unless a subclass defines another.

        Args:
            in_process: whether the worker works in this process and at once, as a test needs it.
        """
        from afspm.scheduler.coordinate_frame import TIP_FRAME

        return Coordinates(TIP_FRAME)


def _epoch(context: ProcessContext) -> bytes:
    from afspm.model.fencing import Epoch

    launch = context.launch
    return Epoch(launch.run, context.clock.now_ns(), launch.simulated).encode() if launch.run else b""


def _restore(core: SchedulerCore, state: StateFile, log: Path | None) -> None:
    from afspm.storage.packet_log import cached_packets

    try:
        if (saved := state.load()) is not None:
            core.restore(saved)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            f"the state saved before the restart can't be read: {error!r}",
            where=str(state.path),
            hint="delete the file to start with control free and no problem flagged",
        ) from error
    if log is not None:
        core.restore_cache(cached_packets(log))


def _section(type_: type[T], plain: Mapping[str, object], name: str) -> T:
    try:
        made: T = from_plain(type_, plain)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise ConfigError(f"the settings can't be used: {error}", where=f"[{name}]") from error
    return made


def _mapping(name: str) -> EnvelopeMapping:
    module, _, function = name.rpartition(".")
    try:
        mapping = getattr(named_imports.import_named(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(f"the mapping {name!r} can't be loaded: {error}", where="[cache] mapping") from error
    if not callable(mapping):
        raise ConfigError(f"{name!r} is not a function", where="[cache] mapping")
    named_imports.require_trusted(mapping, name)
    return mapping  # type: ignore[no-any-return]
