"""What the tests of the transport share: ports that are closed at the end, and waiting with a deadline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from afspm.transport.network import DISCONNECTED


@pytest.fixture
def open_() -> Iterator[Callable[[Any], Any]]:
    """`open_(thing)` returns `thing`, and closes it at the end of the test."""
    with ExitStack() as stack:

        def opened(thing: Any) -> Any:
            stack.callback(thing.close)
            return thing

        yield opened


class Gone:
    """Records the connections that a publisher sees end."""

    def __init__(self, publisher: Any) -> None:
        self._drain = publisher.monitor.drain
        self._kinds: list[int] = []
        publisher.monitor.drain = self._recorded

    def _recorded(self) -> list[Any]:
        events: list[Any] = self._drain()
        self._kinds += [event.kind for event in events if event.kind == DISCONNECTED]
        return events

    def take(self) -> list[int]:
        """Return those since the last call."""
        kinds, self._kinds = self._kinds, []
        return kinds


@pytest.fixture
def gone() -> type[Gone]:
    return Gone


@pytest.fixture
def until() -> Callable[..., Any]:
    """See `wait_until`."""
    return wait_until


def wait_until(condition: Callable[[], Any], *pumped: Any, timeout_s: float = 10.0) -> Any:
    """Poll the ports in turn, collecting what they receive, until `condition()` is true; returns its value.

    `pumped` are pairs (port, list to append to).
    """
    deadline_s = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline_s, "it did not happen in time"
        for port, found in pumped:
            found += port.poll(0.005)
    return value
