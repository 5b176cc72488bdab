"""A dashboard that joins an experiment that runs already."""

from __future__ import annotations

import dataclasses
import logging
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import FileError
from afspm.client.connect import guest_of
from afspm.plugins.web.dashboard.dashboard import Dashboard
from afspm.record.run_json import STATE_DIR
from afspm.storage.memory import Memory
from afspm.transport.port import ParentGone, Port
from afspm.transport.process.context import ProcessActivity, ProcessContext, new_session
from afspm.transport.zmq_port import open_port
from afspm.wire.message_types import register_all


def join(folder: Path, dashboard: Dashboard, name: str) -> int:
    """Show the run in `folder` until it ends, or Ctrl-C; returns an exit code of components.

    Args:
        name: whom the scheduler knows it as; it has to have the role `operate` to command the microscope in MANUAL.

    Raises:
        FileError, ConfigError: there is no run in the folder, or nobody in it to connect to; the address is taken …
    """
    launch = guest_of(folder, name)
    register_all(launch.messages)
    launch = dataclasses.replace(launch, run_dir=str(folder), state_dir=str(folder / STATE_DIR))
    clock = ExperimentClock.from_dict(launch.clock)
    port = open_port(launch, clock)
    context = ProcessContext(
        launch,
        clock,
        open_port=lambda: port,
        log=logging.getLogger(f"afspm.{name}"),
        activity=ProcessActivity(clock),
        session=new_session(launch.run),
    )
    with _ended_by_ctrl_c(port):
        return dashboard.run_process(context)


@contextmanager
def _ended_by_ctrl_c(port: Port) -> Iterator[None]:
    """Treat Ctrl-C in the block as a component treats the end of its parent."""

    def end(_number: int, _frame: FrameType | None) -> None:
        port.wake_up(ParentGone())

    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def url_in(launch_facts: object, folder: Path, name: str) -> str | None:
    """Return where the dashboard that the run was started with is; None if it has none of this name."""
    if not isinstance(launch_facts, dict) or name not in launch_facts:
        return None
    try:
        url = Memory(folder / STATE_DIR / f"{name}.json").get("url")
    except FileError:
        return None
    return url if isinstance(url, str) else None
