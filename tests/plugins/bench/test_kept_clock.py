"""The clock that the bench keeps for a sealed agent."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from afspm.basics import ExperimentClock, InvalidValue, NoResponse, Publication
from afspm_bench.kept_clock import MOST_HOLDS, KeptClock, keeping


@pytest.fixture
def clock(tmp_path: Path) -> ExperimentClock:
    return ExperimentClock.starting_now(speed=1000.0).waiting_in(tmp_path / "clock")


@pytest.fixture
def kept(clock: ExperimentClock) -> Iterator[KeptClock]:
    with keeping(clock) as theirs:
        yield KeptClock(theirs, clock.speed)


def holds(clock: ExperimentClock) -> int:
    shared = clock.holds()
    assert shared is not None
    return len(shared.holds)


def test_agent_reads_the_clock_of_the_run(clock: ExperimentClock, kept: KeptClock) -> None:
    assert clock.now_ns() <= kept.now_ns() <= clock.now_ns()
    assert kept.real_s(500.0) == clock.real_s(500.0) == 0.5


@pytest.mark.parametrize("since", [None, 1e12, Publication.RESULTS, Publication.LINES])
def test_agent_holds_simulated_time(clock: ExperimentClock, kept: KeptClock, since: float | Publication | None) -> None:
    with kept.late(since):
        assert holds(clock) == 1
        assert clock.awaits(Publication.RESULTS) is (since is Publication.RESULTS)
        assert clock.awaits(Publication.LINES) is (since is Publication.LINES)
        with kept.passing():
            assert holds(clock) == 0
        assert holds(clock) == 1
    assert holds(clock) == 0


def test_agent_holds_no_more_than_its_share(clock: ExperimentClock, kept: KeptClock) -> None:
    with ExitStack() as held:
        for _ in range(MOST_HOLDS):
            held.enter_context(kept.late())
        with pytest.raises(InvalidValue, match="held 16 times"):
            held.enter_context(kept.late())
        assert holds(clock) == MOST_HOLDS


@pytest.mark.parametrize("sent", [b"", b"\xff" * 17])
def test_holds_end_with_the_agent_and_with_what_it_may_not_send(clock: ExperimentClock, sent: bytes) -> None:
    with keeping(clock) as theirs:
        kept = KeptClock(theirs, clock.speed)
        with kept.late():
            assert holds(clock) == 1
            theirs.sendall(sent)
            theirs.shutdown(socket.SHUT_WR)
            assert theirs.recv(1) == b""
            with pytest.raises(NoResponse, match="the trial has ended"):
                kept.now_ns()
    assert holds(clock) == 0
