"""Shared by tests of the supervisor."""

from __future__ import annotations

import io
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from deadlines import DEADLINE_S

from afspm.basics.launch import Launch
from afspm.experiment import Role
from afspm.supervisor.process import Task
from afspm.supervisor.supervision.child import ChildPolicy, RestartPolicy
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervisor import RunOutcome, Supervisor

BEAT_S = 0.1
PEER = Path(__file__).with_name("peer.py")
QUICK = ChildPolicy(
    liveness=LivenessPolicy(beat_period_s=0.2, missed_beats=50, start_s=120.0, longest_step_s=10.0),
    restart=RestartPolicy(budget=2, first_delay_s=0.05),
)
IMPATIENT = replace(QUICK, liveness=replace(QUICK.liveness, missed_beats=10))
"""For processes that compute for longer than a silence: each second of it is processor time of the tests."""


class Terminal(io.TextIOBase):
    """A terminal whose lines can be waited for."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._rest = ""
        self._over = False
        self._written = threading.Condition()

    def write(self, text: str) -> int:
        with self._written:
            *lines, self._rest = (self._rest + text).split("\n")
            self.lines += lines
            self._written.notify_all()
        return len(text)

    def close_for_waiters(self) -> None:
        """Release all waiters: no more lines will come."""
        with self._written:
            self._over = True
            self._written.notify_all()

    def wait_for(self, *wanted: str, count: int = 1) -> str:
        """Return the `count`-th line that has all of `wanted` in it; fail after the deadline."""

        def found() -> list[str]:
            return [line for line in self.lines if all(text in line for text in wanted)]

        with self._written:
            self._written.wait_for(lambda: len(found()) >= count or self._over, DEADLINE_S)
            if len(found()) < count:
                raise AssertionError(f"no line with {wanted} came:\n" + "\n".join(self.lines))
            return found()[count - 1]


@dataclass
class Running:
    """A supervisor at work in a thread."""

    supervisor: Supervisor
    terminal: Terminal
    thread: threading.Thread
    outcomes: list[RunOutcome] = field(default_factory=list)

    def pid(self, name: str, life: int = 1) -> int:
        """Return the process id of a task's n-th process."""
        return int(self.terminal.wait_for(f" {name} ", "started, process", count=life).rsplit(" ", 1)[1])

    def stop(self) -> RunOutcome:
        self.supervisor.stop()
        return self.outcome()

    def outcome(self) -> RunOutcome:
        self.thread.join(DEADLINE_S)
        assert self.outcomes, "the run did not end:\n" + "\n".join(self.terminal.lines)
        return self.outcomes[0]


RunTasks = Callable[..., Running]


def peer(name: str, role: Role = Role.COMPONENT, **settings: Any) -> Task:
    """Return a task that runs peer.py."""
    launch = Launch(name=name, settings=settings, beat_period_s=BEAT_S)
    return Task(launch, (sys.executable, str(PEER)), role)
