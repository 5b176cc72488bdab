"""Simulated time that waits for processes that are behind: when it is slow, and from which moment on."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.file_lock import locked
from afspm.basics.shared_time import _NEVER_NS, LONGEST_HOLD_S, MOST_HOLDS, Publication, SharedTime, TimeHold
from afspm.simulation.instrument import SimulatedInstrument

SPEED = 480.0
SPAWN = multiprocessing.get_context("spawn")


def held(*from_s: float, pid: int = 1) -> SharedTime:
    """Return a time at 0 with holds from some experiment times on."""
    shared = SharedTime(0, 0)
    for number, at_s in enumerate(from_s, 1):
        shared = shared.with_hold(TimeHold(number, int(at_s * NS_PER_S), 0, pid))
    return shared.settled()


def at_s(shared: SharedTime, real_s: float) -> float:
    return shared.at(int(real_s * NS_PER_S), SPEED) / NS_PER_S


def test_time_waits_for_a_hold_longer_than_ten_seconds() -> None:
    assert at_s(held(0.0), 0.9 * LONGEST_HOLD_S) == pytest.approx(0.9 * LONGEST_HOLD_S)


def test_time_goes_on_without_a_process_that_hangs() -> None:
    assert at_s(held(0.0), LONGEST_HOLD_S + 2.0) == pytest.approx(LONGEST_HOLD_S + 2.0 * SPEED)


def test_time_is_fast_up_to_the_wake_up_of_a_sleeping_process_and_slow_from_then_on() -> None:
    shared = held(960.0, 4800.0)
    assert at_s(shared, 1.0) == pytest.approx(480.0)
    assert at_s(shared, 2.0) == pytest.approx(960.0)
    assert at_s(shared, 32.0) == pytest.approx(990.0)
    woken = shared.moved_to(32 * NS_PER_S, SPEED).without_hold(shared.holds[0]).settled()
    assert at_s(woken, 33.0) == pytest.approx(990.0 + 480.0)
    assert at_s(woken, 60.0) == pytest.approx(4800.0 + 28.0 - (4800.0 - 990.0) / SPEED)


def test_sleeping_process_that_hangs_does_not_stop_time_for_ever() -> None:
    assert at_s(held(480.0), 1.0 + LONGEST_HOLD_S + 1.0) == pytest.approx(480.0 + LONGEST_HOLD_S + 480.0)


def test_receiver_of_results_is_late_from_their_publication_on() -> None:
    waits = SharedTime(0, 0).with_hold(TimeHold(1, _NEVER_NS + Publication.RESULTS.value, 0, 1)).settled()
    assert at_s(waits, 10.0) == pytest.approx(4800.0)
    later = waits.moved_to(10 * NS_PER_S, SPEED)
    assert at_s(later.with_published(Publication.LINES).settled(), 11.0) == pytest.approx(5280.0)
    assert at_s(later.with_published(Publication.RESULTS).settled(), 11.0) == pytest.approx(4801.0)


def test_limit_of_a_hold_is_not_moved_by_later_changes() -> None:
    shared = held(0.0)
    for second in range(1, int(LONGEST_HOLD_S), 50):
        other = TimeHold(100 + second, 0, 0, 2)
        shared = shared.moved_to(second * NS_PER_S, SPEED).with_hold(other).settled().without_hold(other).settled()
    assert shared.slow_until_ns == int(LONGEST_HOLD_S) * NS_PER_S


@given(
    st.lists(st.tuples(st.floats(0.0, 50.0), st.sampled_from(["hold", "later", "results", "release", "publish"]))),
    st.lists(st.floats(0.0, 60.0), min_size=2),
)
def test_time_never_goes_back_and_never_exceeds_the_speed(steps: list[tuple[float, str]], looks: list[float]) -> None:
    changes = sorted((int(real_s * NS_PER_S), what) for real_s, what in steps)
    moments = sorted(int(real_s * NS_PER_S) for real_s in looks)
    shared, shown, ids = SharedTime(0, 0), list[tuple[int, int]](), itertools.count(1)
    for real_ns in moments:
        while changes and changes[0][0] <= real_ns:
            changed_ns, what = changes.pop(0)
            shared = shared.moved_to(changed_ns, SPEED)
            begin_ns = {"hold": 0, "later": shared.shown_ns + 100 * NS_PER_S, "results": _NEVER_NS}.get(what)
            if begin_ns is not None:
                shared = shared.with_hold(TimeHold(next(ids), begin_ns, 0, 1))
            elif what == "publish":
                shared = shared.with_published(Publication.RESULTS)
            elif shared.holds:
                shared = shared.without_hold(shared.holds[0])
            shared = shared.settled()
        assert SharedTime.from_bytes(shared.as_bytes()) == shared
        shown.append((real_ns, shared.at(real_ns, SPEED)))
    for (before_ns, was_ns), (after_ns, is_ns) in itertools.pairwise(shown):
        passed_ns, rounding_ns = after_ns - before_ns, SPEED * (len(steps) + 2)
        assert passed_ns - rounding_ns <= is_ns - was_ns <= passed_ns * SPEED + rounding_ns


def test_hold_beyond_the_room_is_counted() -> None:
    shared = held(*range(MOST_HOLDS + 2))
    assert (len(shared.holds), shared.refused) == (MOST_HOLDS, 2)
    assert SharedTime.from_bytes(shared.as_bytes()) == shared


def test_half_written_content_is_not_read() -> None:
    packed = held(0.0).as_bytes()
    assert SharedTime.from_bytes(b"torn" + packed[4:]) is None


# --- in processes ---


def shared_clock(tmp_path: Path) -> ExperimentClock:
    return ExperimentClock.starting_now(1_000_000.0, SPEED).waiting_in(tmp_path / "clock")


def holds_of(clock: ExperimentClock) -> tuple[TimeHold, ...]:
    shared = clock.holds()
    assert shared is not None
    return shared.holds


def test_hold_names_its_process_and_ends_with_its_block(tmp_path: Path) -> None:
    clock = shared_clock(tmp_path)
    with clock.late(), clock.late(clock.now_s() + 1e6):
        assert [(one.pid, bool(one.until_ns)) for one in holds_of(clock)] == [(os.getpid(), True), (os.getpid(), False)]
    assert holds_of(clock) == ()


def test_wait_for_others_lets_time_pass_for_this_thread_only(tmp_path: Path) -> None:
    clock = shared_clock(tmp_path)
    is_late, may_go = threading.Event(), threading.Event()

    def other() -> None:
        with clock.late():
            is_late.set()
            may_go.wait()

    thread = threading.Thread(target=other)
    thread.start()
    is_late.wait()
    try:
        with clock.late():
            before = len(holds_of(clock))
            with clock.passing():
                assert len(holds_of(clock)) == before - 1 == 1
            assert len(holds_of(clock)) == before
    finally:
        may_go.set()
        thread.join()


def test_publication_begins_the_hold_of_another_process(tmp_path: Path) -> None:
    clock = shared_clock(tmp_path)
    translator = ExperimentClock.from_dict(clock.as_dict())
    with clock.late(Publication.RESULTS):
        translator.published(Publication.LINES)
        assert not holds_of(clock)[0].until_ns
        translator.published(Publication.RESULTS)
        assert holds_of(clock)[0].until_ns


def _hold_for_ever(clock: dict[str, object], ready: Connection) -> None:
    with ExperimentClock.from_dict(clock).late():
        ready.send(None)
        threading.Event().wait()


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[tuple[ExperimentClock, multiprocessing.process.BaseProcess]]:
    clock = shared_clock(tmp_path)
    here, there = SPAWN.Pipe()
    process = SPAWN.Process(target=_hold_for_ever, args=(clock.as_dict(), there), daemon=True)
    process.start()
    here.recv()
    yield clock, process
    process.kill()
    process.join()


def test_hold_of_a_killed_process_can_be_dropped(
    holder: tuple[ExperimentClock, multiprocessing.process.BaseProcess],
) -> None:
    clock, process = holder
    (hold,) = holds_of(clock)
    assert hold.pid == process.pid
    process.kill()
    process.join()
    assert clock.drop(hold)
    assert holds_of(clock) == ()
    real_ns, began_ns = time.monotonic_ns(), clock.now_ns()
    while time.monotonic_ns() < real_ns + NS_PER_S // 50:
        pass
    assert clock.now_ns() - began_ns >= SPEED * (NS_PER_S // 50)


@pytest.mark.parametrize("since_s", [None, -86_000.0, math.inf])
def test_hold_works_before_1970_and_for_a_sleep_without_end(tmp_path: Path, since_s: float | None) -> None:
    clock = ExperimentClock.starting_now(-86_400.0, SPEED).waiting_in(tmp_path / "clock")
    with clock.late(since_s):
        (hold,) = holds_of(clock)
        assert bool(hold.until_ns) is (since_s is None)
    assert holds_of(clock) == ()


def test_drop_does_not_wait_for_a_process_that_hangs_while_it_writes(tmp_path: Path) -> None:
    clock = shared_clock(tmp_path)
    with clock.late():
        (hold,) = holds_of(clock)
        with (tmp_path / "clock").open("r+b") as file, locked(file):
            assert not clock.drop(hold)
        assert holds_of(clock) == (hold,)


# --- of the simulated instrument ---


def test_time_waits_at_the_end_of_a_scan_that_is_still_being_computed(tmp_path: Path) -> None:
    clock, works = shared_clock(tmp_path), list[Callable[[], None]]()
    instrument = SimulatedInstrument({"surface": "flat"}, 1, clock.now_s(), run=works.append)
    instrument.drawing.clock = clock
    scan = instrument.start_scan(clock.now_s())
    instrument.drawing.release()
    (hold,) = holds_of(clock)
    assert hold.from_ns == int(scan.end_s * NS_PER_S)
    works[0]()
    assert holds_of(clock) == (hold,)  # until a look at the instrument shows the end of the scan
    instrument.drawing.release()
    assert holds_of(clock) == ()
