"""Commands in other languages, and their children, end with the guard that runs them, however the guard ends."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from queue import Queue

import pytest
from deadlines import DEADLINE_S
from systems import KILLED_FROM_OUTSIDE, WINDOWS, kill

from afspm.basics.launch import Launch
from afspm.supervisor.process import GUARD, ChildEvent, ChildProcess, Task
from afspm.supervisor.supervision.supervisor_events import Exited

# a command that ignores its input, with a child that does, too; each keeps a connection while it lives
DEAF = "import socket; socket.create_connection(('127.0.0.1', {port})).recv(1)"
FAMILY = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', {child!r}]); {child}"
SUPERVISOR = (
    "import subprocess, sys; "
    "p = subprocess.Popen({command!r}, stdin=subprocess.PIPE, start_new_session=True); p.stdin.write(b'{{}}\\n'); "
    "p.stdin.flush(); sys.stdin.read()"
)


class Family:
    """A guarded command and its child; the connection of each shows that it lives."""

    def __init__(self, server: socket.socket) -> None:
        self._server = server
        self._calls: list[socket.socket] = []
        child = DEAF.format(port=server.getsockname()[1])
        self.command = [sys.executable, "-m", GUARD, "--", sys.executable, "-c", FAMILY.format(child=child)]

    def wait_there(self) -> None:
        for _ in range(2):
            call, _address = self._server.accept()
            call.settimeout(DEADLINE_S)
            self._calls.append(call)

    def wait_gone(self) -> None:
        for call in self._calls:
            with call, contextlib.suppress(ConnectionResetError):
                assert call.recv(1) == b""  # closed by the system: that process is no more


@pytest.fixture
def family(calls: socket.socket) -> Family:
    return Family(calls)


def test_command_ends_when_its_guard_gets_sigterm(family: Family) -> None:
    events: Queue[ChildEvent] = Queue()
    guard = ChildProcess(Task(Launch("foreign"), tuple(family.command)), events.put)
    family.wait_there()
    guard.close_stdin()
    family.wait_gone()
    assert events.get(timeout=DEADLINE_S) == Exited("foreign", guard.pid, 81)


def test_command_ends_when_its_guard_is_killed(family: Family) -> None:
    events: Queue[ChildEvent] = Queue()
    guard = ChildProcess(Task(Launch("foreign"), tuple(family.command)), events.put)
    family.wait_there()
    kill(guard.pid)  # the guard alone
    family.wait_gone()
    assert events.get(timeout=DEADLINE_S) == Exited("foreign", guard.pid, KILLED_FROM_OUTSIDE)


@pytest.mark.skipif(WINDOWS, reason="a job object of the real supervisor does that there")
def test_command_ends_when_the_supervisor_is_killed(family: Family) -> None:
    code = SUPERVISOR.format(command=family.command)
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as supervisor:
        family.wait_there()
        supervisor.kill()
    family.wait_gone()
