"""A scheduler for tests in which a process joins after the end of the experiment."""

from __future__ import annotations

from unittest import mock

from afspm.scheduler import Scheduler
from afspm.scheduler.control import lifecycle
from afspm.transport import ProcessContext

STAYS_S = 3600.0


class PatientScheduler(Scheduler):
    """A scheduler that stays long after the end: on a busy computer a process needs more than seconds to join."""

    def run_process(self, context: ProcessContext) -> int:
        with mock.patch.multiple(lifecycle, SHUTDOWN_GRACE_S=STAYS_S, LONGEST_GRACE_S=STAYS_S):
            return super().run_process(context)
