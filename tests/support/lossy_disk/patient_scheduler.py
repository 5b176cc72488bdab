"""The scheduler, waiting for its disk as long as a busy computer takes: after 0.2 s it publishes what may be lost."""

from __future__ import annotations

from functools import partial

from afspm.scheduler import Scheduler, write_ahead
from afspm.storage.disk import DiskThread

WITHIN_S = 60.0
vars(write_ahead).update(DEADLINE_S=WITHIN_S, DiskThread=partial(DiskThread, WITHIN_S))


class PatientScheduler(Scheduler):
    """The same scheduler; its name makes the process import this module."""
