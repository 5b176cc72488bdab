"""Experiment time: one for all processes, at any speed."""

from __future__ import annotations

import json
import time

import pytest

from afspm.clock import ExperimentClock


def test_real_time_by_default() -> None:
    clock = ExperimentClock.real()
    # a busy computer may do something else between any two looks, and wall clocks are set a little now and then
    times_s = [time.time() - 1.0, clock.now_s(), clock.now_ns() / 1e9, clock.now_s(), time.time() + 1.0]
    assert times_s == sorted(times_s)
    assert clock.real_s(5.0) == 5.0


def test_a_simulation_begins_where_it_wants_and_passes_faster() -> None:
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
    """As another process is told of it."""
    plain: dict[str, object] = json.loads(json.dumps(clock.as_dict()))
    return plain


@pytest.mark.parametrize("speed", [1.0, 60.0])
@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_who_is_started_after_the_wall_clock_was_set_shows_the_same_time(
    monkeypatch: pytest.MonkeyPatch, step_s: float, speed: float
) -> None:
    wall = time.time
    here = ExperimentClock.starting_now(speed=speed)
    monkeypatch.setattr(time, "time", lambda: wall() + step_s)
    there = ExperimentClock.from_dict(told(here))
    before_ns, other_ns, after_ns = here.now_ns(), there.now_ns(), here.now_ns()
    assert before_ns <= other_ns <= after_ns
    assert here.now_s() == pytest.approx(there.now_s(), abs=1.0 * speed)


def test_on_another_computer_real_time_is_what_the_wall_there_says(monkeypatch: pytest.MonkeyPatch) -> None:
    here = told(ExperimentClock.starting_now(start_s=1_000_000.0))
    far = {**here, "monotonic": "of another boot", "wall_at_zero_s": 5.0}
    assert ExperimentClock.from_dict(far).now_s() == pytest.approx(1_000_000.0, abs=60.0)
    old = {name: here[name] for name in ("origin_s", "start_s", "speed")}
    assert ExperimentClock.from_dict(old).now_s() == pytest.approx(1_000_000.0, abs=60.0)


def test_it_tells_by_how_much_the_wall_clock_has_gone_another_way(monkeypatch: pytest.MonkeyPatch) -> None:
    wall = time.time
    clock = ExperimentClock.starting_now()
    assert clock.wall_ahead_s() == pytest.approx(0.0, abs=0.5)
    monkeypatch.setattr(time, "time", lambda: wall() - 3600.0)
    assert clock.wall_ahead_s() == pytest.approx(-3600.0, abs=0.5)
