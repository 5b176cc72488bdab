"""Experiment time: one for all processes, at any speed."""

from __future__ import annotations

import json
import threading
import time
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest

from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.errors import ConfigError

ROUNDING_S = 1e-6
"""A float of the seconds since 1970 is known to 0.2 µs, which shows where the system's clock goes in larger steps."""


def test_real_time_by_default() -> None:
    clock = ExperimentClock.real()
    # a busy computer may do something else between any two looks, and wall clocks are set a little now and then
    times_s = [time.time() - 1.0, clock.now_s(), clock.now_ns() / 1e9, clock.now_s(), time.time() + 1.0]
    assert min(after_s - before_s for before_s, after_s in pairwise(times_s)) > -ROUNDING_S
    assert clock.real_s(5.0) == 5.0


def test_simulation_begins_at_any_time_and_passes_faster() -> None:
    clock = ExperimentClock.starting_now(start_s=1_000_000.0, speed=1000.0)
    first = clock.now_ns()
    assert first >= 1_000_000 * 10**9
    assert clock.now_s() < 1_000_000.0 + 60_000.0
    assert clock.real_s(60.0) == 0.06


def test_every_process_shows_the_same_time() -> None:
    here = ExperimentClock.starting_now(start_s=0.0, speed=100.0)
    there = ExperimentClock.from_dict(json.loads(json.dumps(here.as_dict())))
    before, other, after = here.now_s(), there.now_s(), here.now_s()
    assert before - 1.0 <= other <= after + 1.0
    assert there == here


def test_nanoseconds_never_go_back() -> None:
    clock = ExperimentClock.starting_now(start_s=1_767_225_600.0, speed=480.0)
    times = [clock.now_ns() for _ in range(1000)]
    assert times == sorted(times)


def told(clock: ExperimentClock) -> dict[str, object]:
    """Return the fields that another process gets."""
    plain: dict[str, object] = json.loads(json.dumps(clock.as_dict()))
    return plain


@pytest.mark.parametrize("speed", [1.0, 60.0])
@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_process_started_after_the_wall_clock_was_set_shows_the_same_time(
    monkeypatch: pytest.MonkeyPatch, step_s: float, speed: float
) -> None:
    wall = time.time
    here = ExperimentClock.starting_now(speed=speed)
    monkeypatch.setattr(time, "time", lambda: wall() + step_s)
    there = ExperimentClock.from_dict(told(here))
    before_ns, other_ns, after_ns = here.now_ns(), there.now_ns(), here.now_ns()
    assert before_ns <= other_ns <= after_ns
    assert here.now_s() == pytest.approx(there.now_s(), abs=1.0 * speed)


def test_another_computer_uses_its_own_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    here = told(ExperimentClock.starting_now(start_s=1_000_000.0))
    far = {**here, "monotonic": "of another boot", "wall_at_zero_s": 5.0}
    assert ExperimentClock.from_dict(far).now_s() == pytest.approx(1_000_000.0, abs=60.0)
    old = {name: here[name] for name in ("origin_s", "start_s", "speed")}
    assert ExperimentClock.from_dict(old).now_s() == pytest.approx(1_000_000.0, abs=60.0)


def test_drift_of_the_wall_clock_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = time.time
    clock = ExperimentClock.starting_now()
    assert clock.wall_ahead_s() == pytest.approx(0.0, abs=0.5)
    monkeypatch.setattr(time, "time", lambda: wall() - 3600.0)
    assert clock.wall_ahead_s() == pytest.approx(-3600.0, abs=0.5)


def waiting(tmp_path: Path, speed: float = 480.0) -> ExperimentClock:
    return ExperimentClock.starting_now(1_000_000.0, speed).waiting_in(tmp_path / "clock")


def test_time_is_no_faster_than_real_time_while_a_process_is_late(tmp_path: Path) -> None:
    clock = waiting(tmp_path)
    other = ExperimentClock.from_dict(json.loads(json.dumps(clock.as_dict())))  # of another process
    with clock.late():
        # the real time encloses the other, so that a process that waits between two looks is no fault of the clock
        outer_s, began_s, inner_s = time.monotonic(), other.now_s(), time.monotonic()
        while time.monotonic() < inner_s + 0.05:
            pass
        passed_s, lasted_s = other.now_s() - began_s, time.monotonic() - outer_s
        assert 0.05 - ROUNDING_S <= passed_s <= 10.0 * lasted_s  # a busy computer does something else between two looks
    began_s, real_s = other.now_s(), time.monotonic()
    while time.monotonic() < real_s + 0.05:
        pass
    assert other.now_s() - began_s >= 0.05 * 480.0


def test_time_never_goes_back_however_many_are_late(tmp_path: Path) -> None:
    clock = waiting(tmp_path)
    seen: list[int] = []
    done = threading.Event()

    def watch() -> None:
        mine = ExperimentClock.from_dict(clock.as_dict())
        seen.append(mine.now_ns())
        while not done.is_set():
            seen.append(mine.now_ns())

    watcher = threading.Thread(target=watch)
    watcher.start()
    for _ in range(50):
        with clock.late(), clock.late():
            pass
    done.set()
    watcher.join()
    assert seen == sorted(seen)
    assert clock.now_ns() >= seen[-1]


def test_time_is_not_read_during_a_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = waiting(tmp_path)
    seen: list[int] = []
    reader = threading.Thread(target=lambda: seen.append(clock.now_ns()))
    monotonic_ns = time.monotonic_ns

    def interrupted() -> int:
        moment_ns = monotonic_ns()
        monkeypatch.undo()
        reader.start()
        reader.join(0.1)  # a writer that waits for a processor; the reader gets no time before it is done
        return moment_ns

    monkeypatch.setattr("afspm.basics.shared_time.time.monotonic_ns", interrupted)
    with clock.late():
        reader.join()
        assert clock.now_ns() >= seen[0]


@pytest.mark.parametrize("is_first", [False, True])
def test_process_later_than_the_limit_slows_time_no_longer(tmp_path: Path, is_first: bool) -> None:
    clock = waiting(tmp_path)
    stacks = [ExitStack(), ExitStack()]
    for stack in stacks:
        stack.enter_context(clock.late())
    stacks[is_first].close()
    real_ns, began_ns = time.monotonic_ns(), clock.now_ns()
    while time.monotonic_ns() < real_ns + NS_PER_S // 50:
        pass
    assert clock.now_ns() - began_ns <= 10 * (time.monotonic_ns() - real_ns)
    stacks[not is_first].close()
    real_ns, began_ns = time.monotonic_ns(), clock.now_ns()
    while time.monotonic_ns() < real_ns + NS_PER_S // 50:
        pass
    assert clock.now_ns() - began_ns >= 480 * (NS_PER_S // 50)


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_real_time_never_waits_and_needs_no_file(tmp_path: Path, speed: float) -> None:
    clock = waiting(tmp_path, speed)
    with clock.late():
        assert list(tmp_path.iterdir()) == []
    assert "waits" not in clock.as_dict()


def test_a_clock_that_waits_is_refused_on_another_computer_and_its_file_may_be_gone(tmp_path: Path) -> None:
    clock = waiting(tmp_path)
    with pytest.raises(ConfigError, match="one computer only"):
        ExperimentClock.from_dict({**clock.as_dict(), "monotonic": "another boot"})
    told = clock.as_dict()
    del clock  # Windows removes no file that is open
    (tmp_path / "clock").unlink()
    assert ExperimentClock.from_dict(told).speed == 480.0


def test_process_killed_while_writing_does_not_stop_the_clock(tmp_path: Path) -> None:
    clock = waiting(tmp_path)
    before_ns = clock.now_ns()
    whole = (tmp_path / "clock").read_bytes()
    with (tmp_path / "clock").open("r+b") as file:
        file.write(b"torn" + whole[4:])
    assert before_ns <= clock.now_ns()
    with clock.late():  # writes it anew
        pass
    assert ExperimentClock.from_dict(clock.as_dict()).now_ns() >= before_ns


def test_clock_file_emptied_by_a_power_cut_does_not_stop_the_clock(tmp_path: Path) -> None:
    waiting = ExperimentClock.starting_now(speed=10.0).waiting_in(tmp_path / "clock")
    told = waiting.as_dict()
    del waiting  # Windows empties no file that is mapped
    (tmp_path / "clock").write_bytes(b"")
    assert ExperimentClock.from_dict(told).speed == 10.0
