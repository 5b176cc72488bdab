from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from deadlines import DEADLINE_S
from tests.system.supervisor.supervisor_lab import QUICK, Running, RunTasks, Terminal

from afspm.basics.clock import ExperimentClock
from afspm.supervisor.log import RunLog
from afspm.supervisor.process import Task
from afspm.supervisor.reporter import Reporter
from afspm.supervisor.supervision.child import ChildPolicy
from afspm.supervisor.supervisor import RunOutcome, Supervisor

REAL = ExperimentClock.real()


@pytest.fixture
def run_tasks(tmp_path: Path) -> Iterator[RunTasks]:
    """Start a supervisor of these tasks; it is stopped after the test."""
    running: list[Running] = []
    logs: list[RunLog] = []

    def start(
        *tasks: Task, policy: ChildPolicy = QUICK, reporter: Reporter | None = None, clock: ExperimentClock = REAL
    ) -> Running:
        terminal = Terminal()
        log = RunLog(tmp_path / "log.txt", clock, terminal=terminal, level=0)  # type: ignore[arg-type]
        logs.append(log)
        supervisor = Supervisor(tasks, log, clock, policy, reporter)
        outcomes: list[RunOutcome] = []

        def run() -> None:
            try:
                outcomes.append(supervisor.run())
            finally:
                log.close()  # lines are shown by a thread of its own: the last may still wait
                terminal.close_for_waiters()

        thread = threading.Thread(target=run, daemon=True)
        one = Running(supervisor, terminal, thread, outcomes)
        running.append(one)
        thread.start()
        return one

    yield start
    for one in running:
        one.supervisor.stop()
        one.supervisor.stop()
        one.thread.join(DEADLINE_S)
    for log in logs:
        log.close()


@pytest.fixture
def calls() -> Iterator[socket.socket]:
    """A server for peers with `call`: a connection stays open as long as its peer lives."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)
        yield server
