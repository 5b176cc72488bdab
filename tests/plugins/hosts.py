"""Processes for translators in these tests: forked, since importing takes most of the time of hundreds of them."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any, Protocol

from afspm.basics import entry_points

HOST = "afspm.supervisor.host"
IMPORTED = [
    *(HOST, "afspm.supervisor.hosting"),
    *("numpy", "h5py", "afspm.translator.translator", "afspm.transport.zmq_server"),
    *entry_points.modules(entry_points.DRIVERS),
]


class Host(Protocol):
    """The used part of `subprocess.Popen`."""

    stdin: IO[bytes]
    stderr: IO[bytes]

    def kill(self) -> None: ...
    def wait(self, timeout: float) -> int: ...


def host(environment: Mapping[str, str]) -> Host:
    """Start a process like `python -m afspm.supervisor.host`, forked from a process with the imports if possible.

    The tests of experiments cover its ordinary start.
    """
    if "forkserver" in multiprocessing.get_all_start_methods():
        return _Forked(environment)
    pipes: Any = subprocess.Popen(
        [sys.executable, "-m", HOST], stdin=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    )
    return pipes  # type: ignore[no-any-return]


class _Forked:
    def __init__(self, environment: Mapping[str, str]) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(IMPORTED)
        (stdin, to_it), (from_it, stderr) = os.pipe(), os.pipe()
        self.stdin: IO[bytes] = os.fdopen(to_it, "wb")
        self.stderr: IO[bytes] = os.fdopen(from_it, "rb")
        with Connection(stdin) as its_stdin, Connection(stderr) as its_stderr:  # these find their way into it
            settings = dict(environment), Path.cwd()
            self._process = context.Process(target=_run, args=(its_stdin, its_stderr, *settings))
            self._process.start()

    def kill(self) -> None:
        self._process.kill()

    def wait(self, timeout: float) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired(HOST, timeout)
        return self._process.exitcode


def _run(stdin: Connection, stderr: Connection, environment: Mapping[str, str], folder: Path) -> None:
    from afspm.supervisor import host
    from afspm.transport.process.parent import end_within

    for number, pipe in ((0, stdin), (2, stderr)):
        with pipe:
            os.dup2(pipe.fileno(), number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    tempfile.tempdir = None  # the environment says where
    code = int(host.main())
    end_within(host.EXIT_GRACE_S, code)
    sys.exit(code)
