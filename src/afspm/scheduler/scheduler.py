"""The scheduler as the host of processes runs it."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from afspm.errors import FileError
from afspm.exit_codes import ExitCode
from afspm.logic.fencing import Epoch
from afspm.logic.scheduler_core import SchedulerCore
from afspm.logic.settings import SchedulerSettings
from afspm.process.context import ProcessContext
from afspm.scheduler.settings import scheduler_settings
from afspm.scheduler.shell import SchedulerShell
from afspm.scheduler.state_file import StateFile
from afspm.scheduler.wire_codec import WireCodec
from afspm.scheduler.write_ahead import WriteAhead
from afspm.storage.packet_log import PacketLog, cached_packets, log_folder
from afspm.transport.probe import versions_here
from afspm.transport.rate_limited_log import RateLimitedLog
from afspm.transport.scheduler_sockets import SchedulerSockets


class Scheduler:
    """Lets one component at a time command the microscope, and gives everybody what was published.

    Killed and restarted it goes on where it was: mode, holder and problems, and everything that it publishes, are on
    disk before anybody is told of them.

    Args:
        control: the section [control] of the experiment file, durations in s.
        limits: the section [limits].
        cache: the section [cache].
    """

    def __init__(
        self,
        control: Mapping[str, object] | None = None,
        limits: Mapping[str, object] | None = None,
        cache: Mapping[str, object] | None = None,
    ) -> None:
        self._control = control or {}
        self._limits = limits or {}
        self._cache = cache or {}

    def run_process(self, context: ProcessContext) -> int:
        """Run until the experiment ends or we are told to stop; returns an exit code.

        Raises:
            AfspmError: an address, a setting or what was saved can't be used.
        """
        launch, clock, log = context.launch, context.clock, context.log
        folder = Path(launch.state_dir) if launch.state_dir else None
        state = StateFile(folder and folder / f"{launch.name}.json", log)
        core = self._core(context)
        _restore(core, state, log_folder(folder) if folder else None)
        write_ahead = WriteAhead(state, PacketLog(log_folder(folder)) if folder else None, core.cached, log)
        warnings = RateLimitedLog(log, clock)
        sockets = SchedulerSockets(launch, warnings, clock, since_ns=core.newest_source_ns, epoch=_epoch(context))
        stopping = threading.Event()

        def stop() -> None:
            stopping.set()
            sockets.wake_up()

        context.when_stopping(stop)
        shell = self._shell(core, sockets, clock, write_ahead, warnings, log)
        try:
            shell.start()
            while not (shell.over or stopping.is_set()):
                ready = shell.wait()
                with context.activity.step():
                    shell.handle(ready)
            shell.stop()
        finally:
            sockets.close()
            shell.close()
        return ExitCode.ENDED if shell.ended else ExitCode.ORPHAN

    def _settings(self, context: ProcessContext) -> SchedulerSettings:
        settings = scheduler_settings(
            self._control, self._limits, self._cache, context.problems, context.launch.request_timeout_s
        )
        launch = context.launch
        versions = asdict(versions_here())
        return replace(
            settings, clock=dict(launch.clock), run=launch.run, simulated=launch.simulated, versions=versions
        )

    def _core(self, context: ProcessContext) -> SchedulerCore:
        return SchedulerCore(self._settings(context), WireCodec())

    def _shell(self, core: SchedulerCore, sockets: SchedulerSockets, *others: Any) -> SchedulerShell:
        return SchedulerShell(core, sockets, *others)


def _epoch(context: ProcessContext) -> bytes:
    launch = context.launch
    return Epoch(launch.run, context.clock.now_ns(), launch.simulated).encode() if launch.run else b""


def _restore(core: SchedulerCore, state: StateFile, log: Path | None) -> None:
    try:
        if (saved := state.load()) is not None:
            core.restore(saved)
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(
            f"what was in force before the restart can't be understood: {error!r}",
            where=str(state.path),
            hint="delete the file to begin with nobody in control",
        ) from error
    if log is not None:
        core.restore_cache(cached_packets(log))
