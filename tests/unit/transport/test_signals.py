"""Signals that end a program are passed on, also SIGHUP of a closed terminal."""

from __future__ import annotations

import signal
import socket
import sys
from collections.abc import Iterator

import pytest

from afspm.transport.process import signals


@pytest.fixture
def writer() -> Iterator[int]:
    """Yield the descriptor that wakes a poller up."""
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    with ours, theirs:
        yield theirs.fileno()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_caught_signal_is_passed_on_and_ends_nothing(name: str, writer: int) -> None:
    number = getattr(signal, name, None)
    if number is None or (sys.platform == "win32" and name == "SIGTERM"):
        pytest.skip("no such signal here")
    told: list[int] = []
    before = signal.signal(number, signal.default_int_handler)  # whatever the tests themselves were begun with: nohup
    try:
        with signals.caught(told.append, writer):
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, before)
    assert told == [number]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGHUP")
def test_under_nohup_the_closing_of_the_terminal_stays_ignored(writer: int) -> None:
    told: list[int] = []
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.caught(told.append, writer):
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert told == []
