"""Who reports to the scheduler of an experiment, wherever that runs."""

from __future__ import annotations

import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from afspm.addresses import connectable
from afspm.clock import Clock
from afspm.experiment import Experiment, ProcessStart, Role
from afspm.launch import Launch, Sockets
from afspm.logic.supervisor_registry import SUPERVISOR
from afspm.supervisor.reporter import Reporter

_LONGEST = 60


def reporter(
    experiment: Experiment,
    starts: Sequence[ProcessStart],
    clock: Clock,
    run: str = "",
    keys: Mapping[str, Any] | None = None,
) -> Reporter | None:
    """One for what is started here; None where the scheduler can't be asked, or is perhaps none of ours.

    Args:
        keys: that were made for it; None: the file says where they are, or there are none.
    """
    scheduler = next((start for start in starts if start.role is Role.SCHEDULER), None)
    here = re.sub(r"[^\w.-]+", "-", platform.node())[:_LONGEST] or "computer"
    if scheduler is None:
        launch = experiment.asking([start.launch.name for start in starts])
        launch = launch and replace(launch, run=run)
        here = f"{here}-{os.getpid()}"  # there may be several parts on one computer
    else:
        launch = _local(scheduler)
    if launch is None:
        return None
    return Reporter(replace(launch, name=f"{SUPERVISOR}:{here}", keys=keys or launch.keys), clock, here)


def _local(scheduler: ProcessStart) -> Launch | None:
    """How a scheduler is asked that is started here."""
    launch = scheduler.launch
    if scheduler.command or launch.sockets.serve is None:
        return None
    address, keys = connectable(launch.sockets.serve), launch.keys
    if keys is not None and "folder" in keys:
        keys = {"folder": keys["folder"], address: launch.name}
    return Launch(SUPERVISOR, sockets=Sockets(control=address), keys=keys, run=launch.run)
