"""A child process: output, exit and end are reported in every case."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import Queue
from typing import Any

import pytest
from deadlines import DEADLINE_S
from systems import KILLED, freeze, not_on_wine

from afspm.basics.errors import AfspmError
from afspm.basics.launch import Launch
from afspm.supervisor import reaper
from afspm.supervisor.child_output import OutputDropped, OutputLine
from afspm.supervisor.process import ChildEvent, ChildProcess, Task
from afspm.supervisor.supervision.supervisor_events import Exited

Start = Callable[[str], ChildProcess]


def python(code: str) -> Task:
    return Task(Launch("child"), (sys.executable, "-c", code))


@pytest.fixture
def events() -> Queue[ChildEvent]:
    return Queue()


@pytest.fixture
def start(events: Queue[ChildEvent]) -> Iterator[Start]:
    started: list[ChildProcess] = []

    def run(code: str) -> ChildProcess:
        child = ChildProcess(python(code), events.put)
        started.append(child)
        return child

    yield run
    for child in started:
        child.kill()


def test_the_launch_line_arrives_and_the_answer_comes_back(start: Start, events: Queue[ChildEvent]) -> None:
    child = start("print(input())")
    assert events.get(timeout=DEADLINE_S) == OutputLine("child", child.pid, "stdout", Launch("child").to_json())
    assert events.get(timeout=DEADLINE_S) == Exited("child", child.pid, 0)


def test_last_output_comes_before_the_exit(start: Start, events: Queue[ChildEvent]) -> None:
    child = start("import sys; print('it broke', file=sys.stderr); sys.exit(3)")
    assert events.get(timeout=DEADLINE_S) == OutputLine("child", child.pid, "stderr", "it broke")
    assert events.get(timeout=DEADLINE_S) == Exited("child", child.pid, 3)


def test_invalid_utf8_output_is_shown_with_replacements(start: Start, events: Queue[ChildEvent]) -> None:
    start(r"import sys; sys.stdout.buffer.write(b'caf\xe9\n')")
    printed = events.get(timeout=DEADLINE_S)
    assert isinstance(printed, OutputLine)
    assert printed.line == "caf\N{REPLACEMENT CHARACTER}"


def test_closing_stdin_ends_a_child_that_waits_for_it(start: Start, events: Queue[ChildEvent]) -> None:
    child = start("import sys; print('up', flush=True); sys.stdin.read(); sys.exit(81)")
    assert isinstance(events.get(timeout=DEADLINE_S), OutputLine)
    child.close_stdin()
    assert events.get(timeout=DEADLINE_S) == Exited("child", child.pid, 81)


def test_a_child_that_does_not_read_its_launch_line_does_not_block_us(events: Queue[ChildEvent]) -> None:
    deaf = [sys.executable, "-c", "import time; print('up', flush=True); time.sleep(60)"]
    child = ChildProcess(Task(Launch("deaf", settings={"long": "x" * 1_000_000}), tuple(deaf)), events.put)
    assert isinstance(events.get(timeout=DEADLINE_S), OutputLine)
    child.close_stdin()
    exited = events.get(timeout=DEADLINE_S)
    assert isinstance(exited, Exited)
    assert exited.code != 0


def test_killing_a_child_kills_its_own_children(start: Start, events: Queue[ChildEvent]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)
        port = server.getsockname()[1]
        grandchild = f"import socket; socket.create_connection(('127.0.0.1', {port})).recv(1)"
        child = start(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {grandchild!r}])")
        connection, _ = server.accept()
        with connection:
            connection.settimeout(DEADLINE_S)
            child.kill()
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""  # the system closes it when the grandchild is gone
    assert events.get(timeout=DEADLINE_S) == Exited("child", child.pid, KILLED)


def test_a_frozen_child_can_be_killed(start: Start, events: Queue[ChildEvent]) -> None:
    child = start("import sys; print('up', flush=True); sys.stdin.read()")
    assert isinstance(events.get(timeout=DEADLINE_S), OutputLine)
    freeze(child.pid)
    child.kill()
    assert events.get(timeout=DEADLINE_S) == Exited("child", child.pid, KILLED)


def test_missing_program_is_named(events: Queue[ChildEvent]) -> None:
    with pytest.raises(AfspmError, match="no-such-program"):
        ChildProcess(Task(Launch("child"), ("no-such-program",)), events.put)


@pytest.mark.skipif(sys.platform == "win32", reason="a pipe handed on by inheritance is a matter of POSIX")
def test_a_child_does_not_hold_the_stdin_of_another_open(start: Start, events: Queue[ChildEvent]) -> None:
    first = start("import sys; print('up', flush=True); sys.stdin.read()")
    assert isinstance(events.get(timeout=DEADLINE_S), OutputLine)
    start("import sys; print('up', flush=True); sys.stdin.read()")
    assert isinstance(events.get(timeout=DEADLINE_S), OutputLine)
    first.close_stdin()
    assert events.get(timeout=DEADLINE_S) == Exited("child", first.pid, 0)


def test_output_arrives_without_delay(start: Start, events: Queue[ChildEvent]) -> None:
    start("import sys; print('at once'); sys.stdin.read()")
    printed = events.get(timeout=DEADLINE_S)
    assert isinstance(printed, OutputLine)
    assert printed.line == "at once"


@not_on_wine("200,000 writes to a pipe take minutes")
def test_endless_output_of_a_child_is_not_kept_in_memory(start: Start, events: Queue[ChildEvent]) -> None:
    start("for i in range(200_000): print('waiting', i)\nraise SystemExit('no stage')")
    got = [events.get(timeout=DEADLINE_S)]
    while not isinstance(got[-1], Exited):
        got.append(events.get(timeout=DEADLINE_S))
    printed = [event.line for event in got if isinstance(event, OutputLine)]
    left_out = sum(event.lines for event in got if isinstance(event, OutputDropped))
    assert printed[0] == "waiting 0"
    assert {"waiting 199999", "no stage"} <= set(printed)
    assert len(printed) < 10_000
    assert left_out + len(printed) == 200_001


def test_child_environment_lacks_secrets_of_other_processes(
    start: Start, events: Queue[ChildEvent], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NIGHT_HOOK", "secret")
    monkeypatch.setenv("NIGHT_LAMP", "on")
    code = "import os; print(os.environ.get('NIGHT_HOOK'), os.environ.get('NIGHT_LAMP'))"
    child = ChildProcess(replace(python(code), hidden=("NIGHT_HOOK",)), events.put)
    assert events.get(timeout=DEADLINE_S) == OutputLine("child", child.pid, "stdout", "None on")


KILLED_SUPERVISOR = """
import os, sys, threading
from afspm.basics.launch import Launch
from afspm.supervisor.process import ChildProcess
from afspm.supervisor.reaper import Reaper
from afspm.supervisor.process import Task
port, holds_lock = int(sys.argv[1]), "import ctypes; " + (
    "ctypes.PyDLL('kernel32').Sleep(-1)" if sys.platform == "win32" else "ctypes.PyDLL(None).pause()"
)
call = f"import socket; s = socket.create_connection(('127.0.0.1', {port})); s.sendall(b'x'); "
child = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', sys.argv[1] + 's.recv(1)']); " + call
reaper = Reaper()
reaper.begin()
code = child + (holds_lock if sys.argv[2] == "holds" else "sys.stdin.read()")
child = ChildProcess(Task(Launch("child"), (sys.executable, "-c", code, call)), print)
reaper.watch(child.pid, has_tip=False)
os.write(1, b"watched")
threading.Event().wait()
"""


@pytest.mark.parametrize("what", ["holds", "leaves"])
def test_nothing_outlives_a_supervisor_that_was_killed(what: str) -> None:
    """One child holds Python's lock and can't see the end; another ends but leaves a child behind."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(DEADLINE_S)
        port = str(server.getsockname()[1])
        command = [sys.executable, "-c", KILLED_SUPERVISOR, port, what]
        supervisor = subprocess.Popen(command, stdout=subprocess.PIPE, bufsize=0)
        connections = [server.accept()[0] for _ in range(2)]
        for connection in connections:
            connection.settimeout(DEADLINE_S)
            assert connection.recv(1) == b"x"
        assert supervisor.stdout is not None
        with supervisor.stdout as output:
            assert output.read(7) == b"watched"  # the children may be there before
        supervisor.kill()
        supervisor.wait()
        for connection in connections:
            with connection, contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has job objects instead of the reaper process")
def test_reaper_that_does_not_end_by_itself_is_joined(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def start(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        begun.append(popen(*arguments, **options))
        return begun[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(reaper, "CLOSED_WITHIN_S", 0.01)
    one = reaper.Reaper()
    one.begin()
    freeze(begun[0].pid)
    one.close()
    assert begun[0].returncode is not None
