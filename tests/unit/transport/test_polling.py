"""How long is waited, and for what."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zmq

from afspm.transport.polling import Poller, PortablePoller, milliseconds, poller
from afspm.transport.wakeup import WakeUp

LONG_MS = 30_000


@pytest.fixture
def wake_up() -> Iterator[WakeUp[str]]:
    made: WakeUp[str] = WakeUp()
    yield made
    made.close()


@pytest.fixture(params=[Poller, PortablePoller])
def waiting(request: pytest.FixtureRequest, wake_up: WakeUp[str]) -> Poller[str] | PortablePoller[str]:
    made: Poller[str] | PortablePoller[str] = request.param(wake_up)
    return made


class Owner:
    touched = False


@pytest.mark.parametrize("timeout_s", [3e6, 1e30, math.inf])
def test_a_deadline_beyond_what_a_poller_can_wait_for_is_waited_for_in_parts(
    wake_up: WakeUp[str], timeout_s: float
) -> None:
    wake_up.post("come")
    _, woken = poller(wake_up).wait(milliseconds(timeout_s))
    assert woken
    assert wake_up.take() == ["come"]


def test_no_deadline_is_none_and_a_part_of_a_millisecond_is_one() -> None:
    assert (milliseconds(None), milliseconds(0.0001), milliseconds(-1.0)) == (None, 1, 0)


def pair(plain: Callable[[int], Any]) -> tuple[Any, Any]:
    near, far = plain(zmq.PAIR), plain(zmq.PAIR)
    near.connect(f"tcp://127.0.0.1:{far.bind_to_random_port('tcp://127.0.0.1')}")
    far.send(b"connected")
    near.recv()
    near.poll(0)  # takes notice of all news so far
    return near, far


def test_a_rest_is_ended_by_what_is_urgent_alone(
    waiting: Poller[str] | PortablePoller[str], plain: Callable[[int], Any]
) -> None:
    (scans, far_scans), (answers, far_answers) = pair(plain), pair(plain)
    waiting.register(scans, "scans", Owner(), urgent=False)
    waiting.register(answers, "answers", Owner())
    far_scans.send(b"scan")
    assert waiting.wait(LONG_MS) == (["scans"], False)
    began_s = time.monotonic()
    waiting.rest(30)
    assert time.monotonic() - began_s >= 0.03
    far_answers.send(b"answer")
    waiting.rest(LONG_MS)
    assert time.monotonic() - began_s < LONG_MS / 2e3
    assert "answers" in waiting.wait(LONG_MS)[0]


def test_a_rest_is_ended_by_whoever_wakes_us_up(
    waiting: Poller[str] | PortablePoller[str], wake_up: WakeUp[str]
) -> None:
    wake_up.post("parent gone")
    began_s = time.monotonic()
    waiting.rest(LONG_MS)
    assert time.monotonic() - began_s < LONG_MS / 2e3


def test_there_is_no_rest_while_something_is_known_to_be_there(
    wake_up: WakeUp[str], plain: Callable[[int], Any]
) -> None:
    waiting: Poller[str] = Poller(wake_up)
    owner = Owner()
    waiting.register(plain(zmq.PAIR), "scans", owner, urgent=False)
    owner.touched = True  # it received a part only
    began_s = time.monotonic()
    waiting.rest(LONG_MS)
    assert time.monotonic() - began_s < LONG_MS / 2e3
