"""The recording thread writes packets, waits for room on a disk, and asks for missed packets."""

from __future__ import annotations

import contextlib
import errno
import logging
import sqlite3
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from deadlines import DEADLINE_S
from watched_disk import lossy_disk

import afspm
from afspm import wire
from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import FileError
from afspm.basics.exit_codes import ExitCode
from afspm.basics.launch import Launch
from afspm.components import recorder, recording
from afspm.components.recording import RecordWriter, WriterLimits
from afspm.model import (
    ControlMode,
    ControlState,
    LoggedPacket,
    LogLine,
    Packet,
    ProcessCondition,
    ProcessState,
    ProcessStates,
    Region,
    Scan,
    ScanLines,
)
from afspm.record.journal import JOURNAL_FILE
from afspm.record.store import RecordSettings, RecordStore
from afspm.storage.packet_log import LogReader, PacketLog, committed, expect_recorder
from afspm.transport.port import Incoming, ParentGone
from afspm.transport.process.context import ProcessActivity, ProcessContext


def control(time_ns: int, holder: str = "series") -> Packet:
    return Packet("ControlState", wire.encode(ControlState(ControlMode.AUTOMATED, f"{holder}{time_ns}"))[1], time_ns)


class Bench:
    """A run folder with a writer."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.packets = folder / "state" / "packets"
        self.packets.parent.mkdir()
        expect_recorder(self.packets)
        self.log = PacketLog(self.packets)
        self.woken = threading.Event()
        self.writers: list[RecordWriter] = []

    def writer(
        self,
        step: Callable[[], contextlib.AbstractContextManager[None]] | None = None,
        open_store: Callable[[Path, RecordSettings], RecordStore] = RecordStore,
        **limits: int,
    ) -> RecordWriter:
        writer = RecordWriter(
            self.folder,
            self.packets,
            RecordSettings(),
            ExperimentClock.real(),
            logging.getLogger("recorder"),
            step=step or contextlib.nullcontext,
            wake=self.woken.set,
            # after a second `finish` leaves a busy writer to itself, which would write into what a test has changed
            limits=WriterLimits(0.02, 0.02, 0.02, 0.02, 0.02, stopping_s=DEADLINE_S, **limits),
            open_store=open_store,
        )
        self.writers.append(writer)
        writer.start()
        return writer

    def publish(self, *packets: Packet) -> None:
        """Append a packet to the log, as the scheduler does."""
        for packet in packets:
            self.log.append(LoggedPacket(packet, None, 1))

    @property
    def is_committed(self) -> bool:
        """Return whether the whole log is committed as recorded."""
        position = committed(self.packets)
        return position is not None and not LogReader(self.packets, position).read(1)

    def rows(self, query: str) -> list[tuple[Any, ...]]:
        """Return rows of the journal."""
        with contextlib.closing(sqlite3.connect(self.folder / JOURNAL_FILE)) as journal:
            return journal.execute(query).fetchall()

    def times(self) -> list[int | None]:
        """Return the times of the recorded packets; none before the record exists."""
        with contextlib.suppress(FileError), afspm.open_run(self.folder) as run:
            return [packet.time_ns for packet in run.packets()]
        return []


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.log.close()


def test_log_and_packets_of_other_publishers_are_recorded_once_in_order(bench: Bench) -> None:
    bench.publish(*map(control, (1, 2, 3)))
    writer = bench.writer()
    bench.publish(*map(control, (3, 4, 5)))
    _until(lambda: bench.times() == [1, 2, 3, 4, 5])
    writer.put(control(6), "tcp://another")
    bench.publish(control(7))
    writer.finish(ended=True)
    assert bench.times() == [1, 2, 3, 4, 5, 7]
    assert bench.rows("SELECT source FROM packets WHERE time_ns = 6") == [("tcp://another",)]
    assert bench.is_committed


def test_flood_of_packets_is_recorded_in_short_steps_that_follow_each_other(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    activity, reads, plain = ProcessActivity(ExperimentClock.real()), list[tuple[int, bool]](), LogReader.read

    def read(reader: LogReader, *limits: int) -> Any:
        is_in_step = activity.since_s is not None
        found = plain(reader, *limits)
        reads.append((len(found), is_in_step))
        return found

    monkeypatch.setattr(LogReader, "read", read)
    bench.publish(*map(control, range(1, 26)))
    writer = bench.writer(activity.step, most_at_once=10)
    writer.finish(ended=True)
    # a heartbeat between two batches shows a recorder at work, which is not asked to end
    assert reads[:4] == [(10, False), (10, True), (5, True), (0, True)]
    assert bench.times() == [*range(1, 26)]


@pytest.mark.skipif(sys.platform == "win32", reason="Windows removes no open file")
def test_record_that_is_removed_in_a_run_is_logged_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    writer = bench.writer()
    bench.publish(control(1))
    _until(lambda: bench.times() == [1])
    (bench.folder / JOURNAL_FILE).unlink()
    _until(lambda: f"{bench.folder / JOURNAL_FILE} was removed while the run goes on" in caplog.text)
    bench.publish(control(2))
    writer.finish(ended=False)
    assert caplog.text.count("was removed") == 1


def test_open_run_names_the_results_that_wait_in_the_log(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    # faults A3
    image = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((4, 4)))
    bench.publish(control(1))
    bench.writer().finish(ended=False)
    bench.publish(*(Packet("Scan2d_Height", wire.encode(image)[1], time_ns) for time_ns in (100, 200)))
    with afspm.open_run(bench.folder):
        lacking = "the record lacks 2 channels of scans and spectra that the packet log still has; `afspm run --resume "
        assert caplog.text.count(lacking) == 1
    bench.writer().finish(ended=False)
    caplog.clear()
    with afspm.open_run(bench.folder) as run:
        assert len(run.scans) == 2
    assert not caplog.text


def test_restarted_recorder_continues_at_the_committed_position(bench: Bench) -> None:
    bench.publish(*map(control, range(1, 6)))
    bench.writer().finish(ended=False)
    position = committed(bench.packets)
    assert bench.is_committed
    bench.publish(*map(control, range(6, 9)))
    assert committed(bench.packets) == position
    bench.writer().finish(ended=False)
    assert bench.times() == list(range(1, 9))
    assert bench.is_committed


def test_restarted_recorder_reads_lines_of_an_unfinished_scan_again(bench: Bench) -> None:
    region = Region((0.0, 0.0), (1e-6, 1e-6))

    def lines(number: int) -> Packet:
        made = ScanLines(region, (4, 4), "Height", "m", number, np.full((1, 4), float(number)))
        return Packet("ScanLines", wire.encode(made)[1], 100 + number)

    bench.publish(control(1), lines(0))
    bench.writer().finish(ended=False)
    bench.publish(lines(1), control(200))
    bench.writer().finish(ended=False)
    assert not bench.is_committed, "they are recorded with the rest of the scan"
    bench.writer().finish(ended=True)
    (row,) = afspm.open_run(bench.folder).scans
    assert row.interrupted
    assert np.isfinite(afspm.open_run(bench.folder).scan(row).first.values).sum() == 8
    assert bench.is_committed


def test_file_whose_packets_a_power_cut_took_is_kept_and_logged(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    image = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((4, 4)))
    bench.publish(Packet("Scan2d", wire.encode(image)[1], 100), control(200))
    first = bench.writer()
    _until(lambda: bench.times() == [100, 200])
    first.finish(ended=False)
    (file,) = bench.folder.glob("scans/*.h5")
    taken = file.with_stem(f"2{file.stem}")
    taken = file.with_stem("20261102T220000_000000Z-00002")
    taken.write_bytes(file.read_bytes())
    bench.writer().finish(ended=True)
    assert taken.exists()
    (warning,) = [record.getMessage() for record in caplog.records if "in no table" in record.getMessage()]
    assert f"scans/{taken.name}" in warning


@pytest.mark.skipif(sys.platform != "linux", reason="what a descriptor is open on is found in /proc")
def test_committed_packets_are_on_the_disk(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    shadow = lossy_disk(bench.folder, monkeypatch)
    writer = bench.writer()
    for time_ns in range(1, 6):
        bench.publish(control(time_ns))
        _until(lambda: bench.is_committed)
        after = tmp_path_factory.mktemp("after")
        shadow.copy(after)
        with afspm.open_run(after) as run:
            assert [packet.time_ns for packet in run.packets()] == list(range(1, time_ns + 1))
    writer.finish(ended=True)


def test_full_disk_is_logged_once_and_all_is_recorded_once_there_is_room(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    disk = _Disk()
    writer = bench.writer(open_store=disk.open_store)
    _until(lambda: (bench.folder / JOURNAL_FILE).exists())
    disk.is_full = True
    for time_ns in (1, 2):
        bench.publish(control(time_ns))
    _until(lambda: disk.refused > 3)
    disk.is_full = False
    bench.publish(control(3))
    writer.finish(ended=True)
    assert bench.times() == [1, 2, 3]
    lines = [LogLine(1, "recorder", r.levelname, r.message) for r in caplog.records if "can be recorded" in r.message]
    assert [line.level for line in lines] == ["CRITICAL", "INFO"]
    assert lines[1].ends(lines[0])
    assert not writer.wants_replay()


def test_packets_dropped_while_the_disk_was_full_are_requested_again(
    bench: Bench,
) -> None:
    disk = _Disk()
    disk.is_full = True
    writer = bench.writer(open_store=disk.open_store, most_bytes=200)
    writer.put(control(1), "tcp://another")
    _until(lambda: disk.refused > 0)
    packets = [control(time_ns) for time_ns in range(1, 30)]
    for packet in packets:
        writer.put(packet, "tcp://another")
    disk.is_full = False
    assert bench.woken.wait(DEADLINE_S)
    assert writer.wants_replay()
    assert not writer.wants_replay(), "once"
    for packet in packets:  # the publisher sends again what it has kept
        writer.put(packet, "tcp://another")
    writer.finish(ended=True)
    assert _all_times(bench) == [packet.time_ns for packet in packets]


def test_damaged_journal_is_moved_aside_and_logged(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    (bench.folder / JOURNAL_FILE).write_bytes(b"SQLite format 3\0" + b"nonsense" * 1000)
    writer = bench.writer()
    bench.publish(control(1))
    writer.finish(ended=True)
    assert bench.times() == [1]
    assert (bench.folder / f"{JOURNAL_FILE}.damaged-1").exists()
    assert any(record.levelname == "CRITICAL" and "moved it aside" in record.message for record in caplog.records)


@pytest.mark.parametrize("table", ["packets", "packets_once", "packets_by_message"])
def test_journal_damaged_further_in_is_moved_aside_too(
    bench: Bench, caplog: pytest.LogCaptureFixture, table: str
) -> None:
    writer = bench.writer()
    for number in range(1, 400):
        bench.publish(control(number))
    writer.finish(ended=False)
    journal = bench.folder / JOURNAL_FILE
    with contextlib.closing(sqlite3.connect(journal)) as opened:
        (page,) = opened.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
    content = bytearray(journal.read_bytes())
    size = int.from_bytes(content[16:18], "big")
    content[(page - 1) * size : page * size] = b"\xff" * size
    journal.write_bytes(content)
    again = bench.writer()
    bench.publish(control(1000))
    again.finish(ended=True)
    assert (bench.folder / f"{JOURNAL_FILE}.damaged-1").exists()
    assert any("moved it aside" in record.message for record in caplog.records)
    assert bench.times() == [*range(1, 400), 1000], "the log still has what was lost with it"
    assert again.wants_replay()


def test_error_that_ends_the_writing_is_raised_by_check(bench: Bench) -> None:
    writer = bench.writer(open_store=_BrokenStore)
    bench.publish(control(1))
    assert bench.woken.wait(DEADLINE_S)
    with pytest.raises(RuntimeError, match="mistake of ours"):
        writer.check()


def test_packet_without_a_time_gets_the_current_time(bench: Bench) -> None:
    writer = bench.writer()
    writer.put(Packet("ControlState", control(1).payload), "tcp://another")
    writer.finish(ended=True)
    row = bench.rows("SELECT source, time_ns > 0 FROM packets")
    assert row == [("tcp://another", 1)]


def test_writer_wakes_the_port_that_is_open_now(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ports: list[_Port] = []
    made: list[_Writer] = []

    class _Port:
        """Ends the run after enough wake-ups."""

        def __init__(self, heard: tuple[str, ...] | None) -> None:
            self.woken = 0
            ports.append(self)

        def wake_up(self) -> None:
            self.woken += 1

        def wakeup_fileno(self) -> int:
            return -1

        def poll(self, timeout_s: float | None) -> list[Incoming]:
            made[0].wake()
            return [ParentGone()] if len(ports) == 2 else []

        def close(self) -> None:
            pass

    class _Writer:
        """Wants one replay."""

        def __init__(self, *_: object, wake: Callable[[], None], **__: object) -> None:
            self.wake = wake
            made.append(self)

        def wants_replay(self) -> bool:
            return len(ports) == 1

        start = check = finish = lambda self, **_: None

    monkeypatch.setattr(recording, "RecordWriter", _Writer)
    clock = ExperimentClock.real()
    log = logging.getLogger("recorder")
    launch = Launch("recorder", run_dir=str(tmp_path))
    context = ProcessContext(launch, clock, open_port=_Port, log=log, activity=ProcessActivity(clock))  # type: ignore[arg-type]
    monkeypatch.setattr(recorder, "step_back", lambda: None)
    assert recorder.Recorder().run_process(context) == ExitCode.ORPHAN
    assert [port.woken for port in ports] == [1, 1]


@pytest.mark.parametrize("late", [[], [control(5)]], ids=["reports alone", "and control"])
def test_reports_after_the_recorder_has_ended_are_recorded_unless_more_is_missing(
    bench: Bench, late: list[Packet]
) -> None:
    bench.publish(control(1))
    bench.writer().finish(ended=True)
    states = ProcessStates(4, "afspm", (ProcessState("recorder", "component", ProcessCondition.ENDED, 3),))
    bench.publish(Packet("ProcessStates_afspm", wire.encode(states)[1], 4), *late)
    launch = Launch(
        "recorder", "afspm.components.recorder.Recorder", run_dir=str(bench.folder), state_dir=str(bench.packets.parent)
    )
    recorder.record_last_reports(launch, ExperimentClock.real())
    assert bench.is_committed is not bool(late)
    with afspm.open_run(bench.folder) as run:
        assert [packet.time_ns for packet in run.packets()] == ([1] if late else [1, 4])


class _Disk:
    """A disk that may be full."""

    def __init__(self) -> None:
        self.is_full = False
        self.refused = 0

    def open_store(self, folder: Path, settings: RecordSettings) -> RecordStore:
        return _StoreOnDisk(self, folder, settings)


class _StoreOnDisk(RecordStore):
    def __init__(self, disk: _Disk, folder: Path, settings: RecordSettings) -> None:
        self._disk = disk
        super().__init__(folder, settings)

    def take(self, packets: Any) -> None:
        if self._disk.is_full:
            self._disk.refused += 1
            raise OSError(errno.ENOSPC, "No space left on device")
        super().take(packets)


class _BrokenStore(RecordStore):
    def take(self, packets: Any) -> None:
        raise RuntimeError("a mistake of ours")


def _all_times(bench: Bench) -> list[int]:
    return [row[0] for row in bench.rows("SELECT time_ns FROM packets ORDER BY time_ns")]


def _until(condition: Callable[[], bool]) -> None:
    changed = threading.Event()
    clock = ExperimentClock.real()
    until_s = clock.monotonic_s() + DEADLINE_S
    while not condition():
        assert clock.monotonic_s() < until_s, "it did not happen in time"
        changed.wait(0.005)
