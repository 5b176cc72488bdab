from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from queue import Empty, Queue

import pytest
from deadlines import DEADLINE_S

from afspm.basics.launch import Launch

HERE = Path(__file__).parent
HOST = [sys.executable, "-m", "afspm.supervisor.host"]


class Child:
    """A process under test: its lines as they come, and its end."""

    def __init__(self, command: Sequence[str], first_line: str | None) -> None:
        self.popen = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(HERE), "PYTHONUNBUFFERED": "1"},
        )
        self.lines: Queue[str | None] = Queue()
        self.errors = bytearray()
        self._readers = [
            threading.Thread(target=self._read_lines, daemon=True),
            threading.Thread(target=self._read_errors, daemon=True),
        ]
        for reader in self._readers:
            reader.start()
        if first_line is not None:
            self.tell(first_line)

    def tell(self, line: str) -> None:
        """Send a line to its standard input; ignored if the process has ended."""
        assert self.popen.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self.popen.stdin.write(line.encode() + b"\n")
            self.popen.stdin.flush()

    def expect(self, text: str) -> str:
        """Return the next line of its standard output, which must begin with `text`."""
        try:
            line = self.lines.get(timeout=DEADLINE_S)
        except Empty:
            raise AssertionError(f"no line {text!r} came; {self.errors.decode()}") from None
        assert line is not None, f"it ended with {self.popen.wait()} before {text!r}; {self.errors.decode()}"
        assert line.startswith(text), f"{line!r}; {self.errors.decode()}"
        return line

    def let_go(self) -> None:
        assert self.popen.stdin is not None
        self.popen.stdin.close()

    def exit_code(self, within_s: float = DEADLINE_S) -> int:
        code = self.popen.wait(within_s)
        for reader in self._readers:
            reader.join(DEADLINE_S)
        return code

    @property
    def error_text(self) -> str:
        return self.errors.decode().replace("\r\n", "\n")

    def close(self) -> None:
        self.popen.kill()
        self.popen.wait(DEADLINE_S)
        for reader in self._readers:
            reader.join(DEADLINE_S)
            # its pipe is not closed then: that would wait for the reader
            assert not reader.is_alive(), "something that it has started was left behind, and holds its output open"
        for pipe in (self.popen.stdin, self.popen.stdout, self.popen.stderr):
            if pipe is not None:
                pipe.close()

    def _read_lines(self) -> None:
        assert self.popen.stdout is not None
        for line in self.popen.stdout:
            self.lines.put(line.decode().rstrip("\r\n"))
        self.lines.put(None)

    def _read_errors(self) -> None:
        assert self.popen.stderr is not None
        while chunk := self.popen.stderr.read1(65536):  # type: ignore[attr-defined]
            self.errors.extend(chunk)


Start = Callable[..., Child]


@pytest.fixture
def start() -> Iterator[Start]:
    """Start a command with a first line on its standard input; end all remaining processes after the test.

    None: the line is sent later.
    """
    children: list[Child] = []

    def start_one(command: Sequence[str], first_line: str | None) -> Child:
        children.append(Child(command, first_line))
        return children[-1]

    yield start_one
    for child in children:
        child.close()


@pytest.fixture
def host(start: Start) -> Callable[[Launch], Child]:
    """Start a process in afspm's host."""
    return lambda launch: start(HOST, launch.to_json())


@pytest.fixture
def waiting_host(start: Start) -> Child:
    """Start a host without its launch line, but with its imports: on a busy computer they take long."""
    imports = "afspm.supervisor.hosting, afspm.simulation.simulator, process_parts"
    run = "from runpy import run_module; run_module('afspm.supervisor.host', run_name='__main__')"
    host = start([sys.executable, "-c", f"import {imports}; print('imported'); {run}"], None)
    host.expect("imported")
    return host
