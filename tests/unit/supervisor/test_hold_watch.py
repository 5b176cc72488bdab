"""Simulated time goes on without processes that died or hang while it waited for them, which is logged and counted."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from afspm.basics import shared_time
from afspm.basics.clock import NS_PER_S, ExperimentClock
from afspm.basics.shared_time import LONGEST_HOLD_S, MOST_HOLDS, SharedTime, TimeHold
from afspm.supervisor.hold_watch import Drop, HoldWatch, drops

HANGS = TimeHold(1, 0, 5 * NS_PER_S, 11)
WORKS = TimeHold(2, 0, 600 * NS_PER_S, 12)
SLEEPS = TimeHold(3, 10**18, 0, 13)
DIED = TimeHold(4, 10**18, 0, 14)


def test_hold_is_dropped_after_its_limit_or_with_its_process() -> None:
    shared = SharedTime(0, 0, holds=(HANGS, WORKS, SLEEPS, DIED))
    dropped = list(drops(shared, 10 * NS_PER_S, lambda pid: pid != DIED.pid))
    assert dropped == [Drop(HANGS, is_dead=False), Drop(DIED, is_dead=True)]


class _Watched:
    def __init__(self, tmp_path: Path, long_s: float = 60.0) -> None:
        self.clock = ExperimentClock.starting_now(1_000_000.0, 480.0).waiting_in(tmp_path / "clock")
        self.lines: list[tuple[int, str]] = []
        self.watch = HoldWatch(
            self.clock,
            lambda level, text: self.lines.append((level, text)),
            lambda: {os.getpid(): "scheduler"},
            every_s=0.0,
            long_s=long_s,
        )

    @property
    def held(self) -> int:
        shared = self.clock.holds()
        return 0 if shared is None else len(shared.holds)


def test_wait_for_a_living_process_is_given_up_with_a_warning_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_time, "LONGEST_HOLD_S", 0.0)
    watched = _Watched(tmp_path)
    with watched.clock.late():
        watched.watch.look()
        assert (watched.held, watched.watch.given_up) == (0, 1)
    ((level, text),) = watched.lines
    assert level == logging.WARNING
    assert "10 min for scheduler" in text


def test_long_wait_is_logged_once(tmp_path: Path) -> None:
    watched = _Watched(tmp_path, long_s=0.0)
    with watched.clock.late():
        watched.watch.look()
        watched.watch.look()
        assert watched.held == 1
    ((level, text),) = watched.lines
    assert (level, text.split(" has waited ")[1].rpartition(" ")[2]) == (logging.INFO, "scheduler")


def test_time_goes_on_when_its_holder_is_killed(tmp_path: Path) -> None:
    watched = _Watched(tmp_path)
    program = f"""
from afspm.basics.clock import ExperimentClock
with ExperimentClock.from_dict({watched.clock.as_dict()!r}).late():
    print(flush=True)
    input()
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        watched.watch.look()
        assert watched.held == 1
        holder.kill()
        holder.wait()
    watched.watch.look()
    assert (watched.held, watched.watch.given_up) == (0, 0)


def test_refused_hold_is_logged_and_counted(tmp_path: Path) -> None:
    watched = _Watched(tmp_path)
    with ExitStack() as holds:
        for _ in range(MOST_HOLDS + 1):
            holds.enter_context(watched.clock.late())
        watched.watch.look()
    assert watched.watch.given_up == 1
    assert [text for _, text in watched.lines] == [
        "simulated time did not wait 1 time: too many processes are behind",
    ]


def test_clock_at_real_speed_has_no_holds() -> None:
    HoldWatch(ExperimentClock.real(), lambda level, text: pytest.fail(text), dict).look()
    assert LONGEST_HOLD_S > 60.0
