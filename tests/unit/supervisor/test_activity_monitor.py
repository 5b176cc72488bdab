"""Activity of a process as the operating system shows it."""

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
    """Return the verdict at the end of a series of samples."""
    now = [0.0]
    vital = ActivityMonitor(1, LATELY_S, lambda pid: signs(now[0]))
    works = vital.work(now[0])
    while now[0] < until_s:
        now[0] += 0.1
        works = vital.work(now[0])
    return works


def test_process_that_uses_processor_time_works() -> None:
    assert judged(lambda now_s: ActivitySample(100.0 + now_s)) is True
    assert judged(lambda now_s: ActivitySample(2.0 * LEAST_SHARE * now_s)) is True


def test_process_that_only_waits_is_idle_despite_earlier_work() -> None:
    assert judged(lambda now_s: ActivitySample(100.0)) is False
    assert judged(lambda now_s: ActivitySample(min(now_s, 8.0))) is False
    assert judged(lambda now_s: ActivitySample(0.2 * LEAST_SHARE * now_s)) is False


def test_process_that_waits_for_a_disk_in_some_samples_works() -> None:
    assert judged(lambda now_s: ActivitySample(0.0, waits_for_disk=round(now_s) % 2 == 0)) is True
    assert judged(lambda now_s: ActivitySample(0.0, waits_for_disk=now_s < 8.0)) is False


def test_runnable_process_without_processor_time_works() -> None:
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=True)) is True
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=now_s < 9.5)) is True
    assert judged(lambda now_s: ActivitySample(0.001 * now_s, runs=now_s < 8.0)) is False


def test_suspended_process_is_idle_at_once() -> None:
    assert judged(lambda now_s: ActivitySample(now_s, stopped=now_s > 9.9)) is False


def test_single_or_missing_sample_gives_no_answer() -> None:
    assert ActivityMonitor(1, LATELY_S, lambda pid: ActivitySample(100.0)).work(0.0) is None
    assert judged(lambda now_s: None) is None
    assert judged(lambda now_s: ActivitySample(now_s) if now_s < 9.9 else None) is None


def test_samples_are_taken_at_intervals() -> None:
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
def test_sample_of_this_process_is_plausible() -> None:
    before = of_process(os.getpid())
    sum(range(10**7))
    after = of_process(os.getpid())
    assert before
    assert after
    assert after.processor_s > before.processor_s
    assert not after.stopped


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_missing_process_has_no_sample() -> None:
    assert of_process(2**22 + 1) is None


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere threads are no processes")
def test_state_of_each_thread_is_sampled() -> None:
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
