"""A trace played back over real sockets."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from pathlib import Path

from afspm.basics.clock import ExperimentClock
from afspm.simulation.emulation.replay import TraceReplay
from afspm.translator.trace import TCP, Trace, TracedConnection, TraceHeader


def test_answer_that_depends_on_another_connection_follows_it_directly(tmp_path: Path) -> None:
    # the end of the scan reaches the second connection between two reads of the first
    replay = TraceReplay(trace=str(recorded(tmp_path / "trace.jsonl")))
    with replay.running(tmp_path / "controller") as address, ExitStack() as stack:
        host, _, port = address.partition(":")
        one, other = (stack.enter_context(socket.create_connection((host, int(port)), 5.0)) for _ in range(2))
        assert ask(one, b"first") == b"FIRST"
        other.sendall(b"end")
        assert ask(one, b"last") == b"LAST"
        assert other.recv(99) == b"END"


def recorded(file: Path) -> Path:
    trace = Trace()
    trace.begin(file, TraceHeader("Any", "1", "2026-11-24T00:00:00+00:00"), ExperimentClock.real())
    one, other = trace.connection(TCP), trace.connection(TCP)
    said(one, b"first")
    other.asked("end", b"end")
    said(one, b"state")
    one.asked("last", b"last")
    told(other, b"END")
    told(one, b"LAST")
    trace.end()
    return file


def said(connection: TracedConnection, content: bytes) -> None:
    connection.asked(content.decode(), content)
    told(connection, content.upper())


def told(connection: TracedConnection, content: bytes) -> None:
    with connection.answering() as answer:
        answer.add(content)


def ask(connection: socket.socket, content: bytes) -> bytes:
    connection.sendall(content)
    return connection.recv(99)
