"""The write-ahead log, on a disk that works, is full, hangs, or loses its power."""

from __future__ import annotations

import errno
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

from afspm.basics.clock import ExperimentClock
from afspm.model import LoggedPacket, Packet
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.write_ahead import StateFile, WriteAhead
from afspm.storage import atomic, disk, packet_log
from afspm.storage.disk import SYNCER, DiskThread
from afspm.storage.packet_log import PacketLog, cached_packets, commit, expect_recorder, logged_packets

STATE = SavedState(last_ns=7)
SYNCED_WITHIN_S = 60.0  # of a busy disk


def own(time_ns: int, envelope: str = "JournalEntries", size: int = 1) -> LoggedPacket:
    return LoggedPacket(Packet(envelope, b"x" * size, time_ns), None, 1)


class FaultyStateFile(StateFile):
    """A state file on a disk that does `before_save` first."""

    before_save: Callable[[], object] = staticmethod(list)

    def save(self, state: SavedState) -> None:
        self.before_save()
        super().save(state)


class FaultyLog(PacketLog):
    """A packet log on a disk that does `before_append` first."""

    before_append: Callable[[], object] = staticmethod(list)

    def append(self, entry: LoggedPacket) -> None:
        self.before_append()
        super().append(entry)


class Bench:
    """A scheduler's disk, with the write-ahead log and the cache."""

    def __init__(self, folder: Path, most_bytes: int = disk.MOST_BYTES, **limits: int) -> None:
        self.packets = folder / "packets"
        self.cached: list[LoggedPacket] = []
        self.state = FaultyStateFile(folder / "scheduler.json", logging.getLogger("scheduler"))
        self.log = FaultyLog(self.packets, **limits)
        self.disk = DiskThread(most_bytes=most_bytes)
        logger = logging.getLogger("scheduler")
        self.writes = WriteAhead(self.state, self.log, lambda: list(self.cached), logger, self.disk)

    def publish(self, *entries: LoggedPacket) -> None:
        self.cached += entries
        self.writes.write(None, entries)

    def wait_for_disk(self) -> None:
        assert self.disk.submit(lambda: None).done.acquire(timeout=DEADLINE_S)

    def logged(self) -> list[int]:
        return [entry.packet.time_ns or 0 for entry in logged_packets(self.packets)]


@pytest.fixture
def make_bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    with ExitStack() as stack:

        def make(**limits: int) -> Bench:
            made = Bench(tmp_path, **limits)
            stack.callback(made.writes.close)
            return made

        yield make


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


def test_written_packets_are_in_the_log_at_once(bench: Bench) -> None:
    bench.publish(own(1))
    bench.writes.write(STATE, [own(2, "ControlState")])
    assert cached_packets(bench.packets) == [own(1), own(2, "ControlState")]
    assert bench.state.load() == STATE


def test_missing_state_is_logged_unless_it_is_the_first(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    assert bench.state.load() is None
    assert not caplog.records
    bench.state.save(STATE)
    bench.state.close()
    SYNCER.now(SYNCED_WITHIN_S)  # Windows removes no open file
    (bench.packets.parent / "scheduler.json").unlink()
    assert bench.state.load() is None
    assert "no problem is flagged" in caplog.text


def full() -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_packets_that_found_no_room_are_written_before_later_ones(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    bench.publish(own(1))
    bench.log.before_append = full
    bench.publish(own(2), own(3))
    bench.publish(own(4))
    del bench.cached[1]  # it is superseded meanwhile
    assert bench.logged() == [1]
    bench.log.before_append = list
    bench.publish(own(5))
    bench.publish(own(6))
    assert bench.logged() == [1, 3, 4, 5, 6]
    assert [record.levelname for record in caplog.records] == ["CRITICAL", "INFO"], "told once, and that it is over"


def test_hanging_disk_is_not_waited_for_and_catches_up(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    answers = threading.Event()
    bench.log.before_append = lambda: answers.wait(DEADLINE_S)
    monkeypatch.setattr(atomic, "SLOW_S", 0.0)
    clock = ExperimentClock.real()
    began_s = clock.monotonic_s()
    for time_ns in range(1, 20):
        bench.publish(own(time_ns))
    assert clock.monotonic_s() - began_s < 10 * disk.DEADLINE_S
    answers.set()
    bench.writes.close()
    assert bench.logged() == list(range(1, 20))
    assert [record.levelname for record in caplog.records if "has not answered" in record.getMessage()] == ["WARNING"]


def test_packets_beyond_the_backlog_are_written_as_far_as_cached(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(most_bytes=1000)
    answers = threading.Event()
    bench.log.before_append = lambda: answers.wait(DEADLINE_S)
    for time_ns in range(1, 8):
        bench.publish(own(time_ns, size=300))
    answers.set()
    bench.wait_for_disk()
    bench.publish(own(8))
    assert bench.logged() == list(range(1, 9))


def test_cached_packets_survive_the_cleaning_of_the_log(
    make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench(segment_bytes=1000, capacity_bytes=3000)
    monkeypatch.setattr(disk, "sync_data", lambda *_: None)  # a busy disk would hold the cleaning up
    bench.publish(own(1, "ControlState"))
    for time_ns in range(2, 100):
        scan = LoggedPacket(Packet("Scan2d", b"s" * 300, time_ns), time_ns, 1)
        bench.cached[1:] = [scan]
        bench.writes.write(None, [scan])
    SYNCER.now(SYNCED_WITHIN_S)  # Windows frees a segment once it is on the disk
    bench.writes.write(None, [scan])
    bench.writes.close()
    assert cached_packets(bench.packets) == [own(1, "ControlState"), scan]
    assert len(bench.logged()) < 30


def test_recorder_that_falls_behind_is_logged(
    make_bench: Callable[..., Bench], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    bench = make_bench(segment_bytes=1000, capacity_bytes=2000, most_unrecorded_bytes=2000)
    expect_recorder(bench.packets)
    for time_ns in range(1, 40):
        bench.writes.write(None, [own(time_ns, size=300)])
    bench.wait_for_disk()
    assert "does not keep up" in caplog.text
    commit(bench.packets, packet_log.Position(10**6, 0))
    for time_ns in range(40, 60):
        bench.writes.write(None, [own(time_ns, size=300)])
    bench.writes.close()
    assert caplog.records[-1].levelname == "INFO", "it is told that it does again"


@pytest.mark.parametrize("steps", range(3))
def test_packet_is_logged_after_the_state_it_reports(bench: Bench, steps: int) -> None:
    done: list[str] = []

    def until_cut(name: str) -> None:
        if len(done) == steps:
            raise OSError("the power is gone")
        done.append(name)

    bench.state.before_save = partial(until_cut, "state")
    bench.log.before_append = partial(until_cut, "packet")
    bench.writes.write(STATE, [own(1)])
    assert done == ["state", "packet"][:steps]
    assert bool(bench.state.load()) == (steps > 0)
    assert bench.logged() == [1] * (steps > 1)
