"""Whether a process stands still, as it is seen from outside."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable

import psutil
import pytest

from afspm.basics.clock import ExperimentClock
from afspm.supervisor.activity_monitor import LEAST_SHARE, ActivityMonitor, ActivitySample, of_process

LATELY_S = 1.5
CLOCK = ExperimentClock.real()


def judged(signs: Callable[[float], ActivitySample | None], until_s: float = 10.0) -> bool | None:
    """What it is found to do at the end of a time in which one looks again and again."""
    now = [0.0]
    vital = ActivityMonitor(1, LATELY_S, lambda pid: signs(now[0]))
    works = vital.work(now[0])
    while now[0] < until_s:
        now[0] += 0.1
        works = vital.work(now[0])
    return works


def test_who_uses_processor_time_works() -> None:
    assert judged(lambda now_s: ActivitySample(100.0 + now_s)) is True
    assert judged(lambda now_s: ActivitySample(2.0 * LEAST_SHARE * now_s)) is True


def test_who_only_waits_stands_still_whatever_it_did_before() -> None:
    assert judged(lambda now_s: ActivitySample(100.0)) is False
    assert judged(lambda now_s: ActivitySample(min(now_s, 8.0))) is False
    assert judged(lambda now_s: ActivitySample(0.2 * LEAST_SHARE * now_s)) is False


def test_who_waits_for_a_disk_works_though_that_is_not_seen_at_every_look() -> None:
    assert judged(lambda now_s: ActivitySample(0.0, waits_for_disk=round(now_s) % 2 == 0)) is True
    assert judged(lambda now_s: ActivitySample(0.0, waits_for_disk=now_s < 8.0)) is False


def test_who_would_work_if_the_processor_were_free_works() -> None:
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=True)) is True
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=now_s < 9.5)) is True
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=now_s < 8.0)) is False


def test_who_was_stopped_stands_still_at_once() -> None:
    assert judged(lambda now_s: ActivitySample(now_s, stopped=now_s > 9.9)) is False


def test_a_single_look_tells_nothing_and_what_can_not_be_seen_neither() -> None:
    assert ActivityMonitor(1, LATELY_S, lambda pid: ActivitySample(100.0)).work(0.0) is None
    assert judged(lambda now_s: None) is None
    assert judged(lambda now_s: ActivitySample(now_s) if now_s < 9.9 else None) is None


def test_nobody_looks_all_the_time() -> None:
    looks = 0

    def look(pid: int) -> ActivitySample:
        nonlocal looks
        looks += 1
        return ActivitySample(0.0)

    vital = ActivityMonitor(1, LATELY_S, look)
    for milliseconds in range(1500):
        vital.work(milliseconds / 1000.0)
    assert looks == 10


@pytest.mark.skipif(sys.platform not in ("linux", "win32"), reason="nothing can be seen there")
def test_what_the_system_says_of_ourselves() -> None:
    before = of_process(os.getpid())
    sum(range(10**7))
    after = of_process(os.getpid())
    assert before
    assert after
    assert after.processor_s > before.processor_s
    assert not after.stopped


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_of_who_is_not_there_nothing_is_seen() -> None:
    assert of_process(2**22 + 1) is None


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads are no processes")
def test_the_state_of_each_thread_is_seen() -> None:
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    try:
        until_s = CLOCK.monotonic_s() + 10.0
        states: set[str] = set()
        while psutil.STATUS_SLEEPING not in states and CLOCK.monotonic_s() < until_s:  # it has just begun
            states = {psutil.Process(one.id).status() for one in psutil.Process().threads()}
            over.wait(0.01)
    finally:
        over.set()
        thread.join()
    assert psutil.STATUS_SLEEPING in states, "it waits, and for no disk"
