"""Timeouts and sources of the poller."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zmq

from afspm.transport.polling import Poller, WakeUp, milliseconds

LONG_MS = 30_000


@pytest.fixture
def wake_up() -> Iterator[WakeUp[str]]:
    made: WakeUp[str] = WakeUp()
    yield made
    made.close()


@pytest.mark.parametrize("timeout_s", [3e6, 1e30, math.inf])
def test_deadline_beyond_the_pollers_limit_is_reached_in_parts(wake_up: WakeUp[str], timeout_s: float) -> None:
    wake_up.post("come")
    _, woken = Poller(wake_up).wait(milliseconds(timeout_s))
    assert woken
    assert wake_up.take() == ["come"]


def test_timeouts_are_rounded_up_and_none_is_unlimited() -> None:
    assert (milliseconds(None), milliseconds(0.0001), milliseconds(-1.0)) == (None, 1, 0)


def test_poller_returns_the_sources_of_readable_sockets(wake_up: WakeUp[str], plain: Callable[[int], Any]) -> None:
    near, far = plain(zmq.PAIR), plain(zmq.PAIR)
    near.connect(f"tcp://127.0.0.1:{far.bind_to_random_port('tcp://127.0.0.1')}")
    waiting: Poller[str] = Poller(wake_up)
    waiting.register(near, "scans")
    far.send(b"scan")
    for _ in range(2):  # as long as nobody has read
        assert waiting.wait(LONG_MS) == (["scans"], False)
    waiting.pause(near)
    assert waiting.wait(0) == ([], False)
    waiting.register(near, "scans")
    near.recv()
    wake_up.post("come")
    assert waiting.wait(LONG_MS) == ([], True)
