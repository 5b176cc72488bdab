"""Shared fixtures of the transport: ports that are closed at the end, and waiting with a deadline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
import zmq
from deadlines import DEADLINE_S


@pytest.fixture(autouse=True)
def constant_queues(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Fail a test in which the queue length of a bound or connected socket is changed: libzmq may crash then."""
    # faults A1
    changed: list[str] = []
    set_option = zmq.Socket.set

    def checked(socket: Any, option: int, value: Any) -> None:
        if option in (zmq.SNDHWM, zmq.RCVHWM) and (address := socket.getsockopt(zmq.LAST_ENDPOINT).rstrip(b"\0")):
            changed.append(f"{zmq.SocketOption(option).name} at {address!r}")
        set_option(socket, option, value)

    monkeypatch.setattr(zmq.Socket, "setsockopt", checked)
    yield
    assert not changed


@pytest.fixture
def open_() -> Iterator[Callable[[Any], Any]]:
    """`open_(thing)` returns `thing`, and closes it at the end of the test."""
    with ExitStack() as stack:

        def opened(thing: Any) -> Any:
            stack.callback(thing.close)
            return thing

        yield opened


@pytest.fixture
def until() -> Callable[..., Any]:
    """See `wait_until`."""
    return wait_until


def wait_until(condition: Callable[[], Any], *pumped: Any, timeout_s: float = DEADLINE_S) -> Any:
    """Poll the ports in turn, collecting what they receive, until `condition()` is true; returns its value.

    `pumped` are pairs (port, list to append to).
    """
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "it did not happen in time"
        for port, found in pumped:
            found += port.poll(0.005)
    return value
