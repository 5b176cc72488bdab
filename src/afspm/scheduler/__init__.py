"""The scheduler as a process: what `logic.scheduling` decides, with sockets and a disk around it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from afspm.scheduler.scheduler import Scheduler

if TYPE_CHECKING:
    from afspm.scheduler.drift.scheduler import DriftCompensatedScheduler

__all__ = ["DriftCompensatedScheduler", "Scheduler"]


def __getattr__(name: str) -> object:
    if name != "DriftCompensatedScheduler":  # loaded only where it is asked for
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from afspm.scheduler.drift.scheduler import DriftCompensatedScheduler

    return DriftCompensatedScheduler
