"""Experiment time: one for all processes, at any speed."""

from __future__ import annotations

import json

import pytest

from afspm.clock import ExperimentClock


def test_real_time_by_default() -> None:
    import datetime

    clock = ExperimentClock.real()
    assert clock.now_s() == pytest.approx(datetime.datetime.now(datetime.UTC).timestamp(), abs=1.0)
    assert clock.now_ns() == pytest.approx(clock.now_s() * 1e9, abs=1e8)
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
