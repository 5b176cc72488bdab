"""The scheduler as a process: what `logic.scheduling` decides, with sockets and a disk around it."""

from __future__ import annotations

from afspm.scheduler.scheduler import Scheduler

__all__ = ["Scheduler"]
