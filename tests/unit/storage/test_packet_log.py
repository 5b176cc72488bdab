"""The packet log: appended before anything is published, read by a restarted scheduler and by the recorder."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from small_disk import file_limit

from afspm.model import LoggedPacket, Packet
from afspm.storage import packet_log
from afspm.storage.disk import SYNCER
from afspm.storage.packet_log import (
    START,
    LogReader,
    PacketLog,
    Position,
    cached_packets,
    commit,
    committed,
    discard_if_recorded,
    expect_recorder,
    logged_packets,
)
from afspm.storage.segment import path_of, read_segment, segments

Logging = Callable[..., PacketLog]
SMALL_SEGMENT = 300
SYNCED_WITHIN_S = 60.0  # of a busy disk


def entry(time_ns: int, size: int = 10, envelope: str = "Scan2d_1.0_Height", history: int = 1) -> LoggedPacket:
    return LoggedPacket(Packet(envelope, bytes([time_ns % 251]) * size, time_ns), time_ns, history)


def times(folder: Path) -> list[int | None]:
    return [one.packet.time_ns for one in logged_packets(folder)]


def commit_all(folder: Path) -> Position:
    reader = LogReader(folder)
    reader.read(1 << 30)
    commit(folder, reader.position)
    return reader.position


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "packets"


@pytest.fixture
def logging(folder: Path) -> Iterator[Logging]:
    """Open the log, each time as another life."""
    made: list[PacketLog] = []

    def make(**settings: int) -> PacketLog:
        made.append(PacketLog(folder, **settings))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def small(logging: Logging) -> Logging:
    """Open a log of four segments of a few packets."""
    return partial(logging, segment_bytes=SMALL_SEGMENT, capacity_bytes=4 * SMALL_SEGMENT)


def test_packets_are_read_in_the_order_of_appending(logging: Logging, folder: Path) -> None:
    log = logging()
    wanted = [
        LoggedPacket(entry(1, 0).packet, 1, 3),
        LoggedPacket(entry(2).packet, None, 1),
        LoggedPacket(entry(5, 200_000).packet, 4, 0),
    ]
    for one in wanted:
        log.append(one)
    assert list(logged_packets(folder)) == wanted, "before it is closed: a kill closes nothing"


def test_a_packet_that_a_kill_cut_off_is_not_in_the_log(logging: Logging, folder: Path) -> None:
    log = logging()
    for time_ns in (1, 2):
        log.append(entry(time_ns))
    (segment,) = segments(folder)
    whole = segment.read_bytes()
    for length in range(len(whole)):
        segment.write_bytes(whole[:length])
        assert times(folder) == ([1] if length >= len(whole) // 2 else [])


def test_another_life_goes_on_in_another_segment(logging: Logging, folder: Path) -> None:
    logging().append(entry(1))
    with path_of(folder, 1).open("ab") as file:
        file.write(b"AFp3 half")
    logging().append(entry(2))
    assert times(folder) == [1, 2]


@pytest.mark.parametrize("size", [40, 100_000], ids=("small", "large"))
def test_a_packet_that_a_power_cut_left_half_new_and_half_old_is_not_in_the_log(
    logging: Logging, folder: Path, size: int
) -> None:
    log = logging()
    for time_ns in (1, 2):
        log.append(entry(time_ns, size))
    (segment,) = segments(folder)
    whole = segment.read_bytes()
    for at in range(len(whole) // 2, len(whole), max(1, size // 50)):
        segment.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        assert times(folder) == [1], at
    segment.write_bytes(whole)
    assert times(folder) == [1, 2]


# --- the cache ---


def test_the_cache_is_rebuilt_with_as_many_of_each_envelope_as_it_held(logging: Logging, folder: Path) -> None:
    log = logging()
    for time_ns in range(1, 10):
        log.append(entry(time_ns, envelope="ControlState", history=1))
        log.append(entry(100 + time_ns, envelope="Scan2d", history=3))
        log.append(entry(200 + time_ns, envelope="ScanLines", history=0))
    assert [one.packet.time_ns for one in cached_packets(folder)] == [9, 107, 108, 109]


def test_cached_packets_of_any_age_stay_in_the_log(small: Logging, folder: Path) -> None:
    log = small()
    old = [entry(1, 40, "ScanParameters2d"), entry(2, 40, "ControlState")]
    for one in old:
        log.append(one)
    for time_ns in range(3, 400):
        log.append(entry(time_ns, 40, "Scan2d"))
        if log.has_grown:
            log.clean([*old, entry(time_ns, 40, "Scan2d")])
        assert [one.packet.time_ns for one in cached_packets(folder)] == [1, 2, time_ns]
    assert len(segments(folder)) <= 6


def test_carried_packets_are_synced_before_the_old_copy_is_freed(
    small: Logging, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = small()
    log.append(entry(1, 40, "ControlState"))
    for time_ns in range(2, 40):
        log.append(entry(time_ns, 40))

    def fails(within_s: float) -> None:
        raise OSError(errno.EIO, "it does not sync")

    monkeypatch.setattr(SYNCER, "now", fails)
    first = path_of(folder, 1).read_bytes()
    with pytest.raises(OSError, match="does not sync"):
        log.clean([entry(1, 40, "ControlState")])
    assert path_of(folder, 1).read_bytes() == first


# --- how much is kept ---


def test_segments_that_are_not_recorded_yet_are_kept(small: Logging, folder: Path) -> None:
    expect_recorder(folder)
    log = small()
    for time_ns in range(1, 60):
        log.append(entry(time_ns, 40))
        assert log.clean([])
    assert times(folder) == list(range(1, 60))
    reader = LogReader(folder)
    read = reader.read(30 * 40)
    commit(folder, reader.position)
    log.clean([])
    kept = [time_ns for time_ns in times(folder) if time_ns is not None]
    assert kept[0] <= (read[-1][0].packet.time_ns or 0) + 1
    assert kept == list(range(kept[0], 60))
    assert kept[0] > 20


def test_recorded_segments_are_overwritten(small: Logging, folder: Path) -> None:
    expect_recorder(folder)
    log = small()
    for time_ns in range(1, 200):
        log.append(entry(time_ns, 40))
        commit_all(folder)
        log.clean([])
    assert len(list(folder.iterdir())) <= 8
    kept = [time_ns or 0 for time_ns in times(folder)]
    assert kept == list(range(kept[0], 200)), "what was in the files before is not found again"


def test_new_life_ignores_remains_in_an_overwritten_segment(small: Logging, folder: Path) -> None:
    log = small()
    for time_ns in range(1, 60):
        log.append(entry(time_ns, 40))
        log.clean([])
    log.close()
    position = commit_all(folder)
    other = small()
    for time_ns in range(60, 90):
        other.append(entry(time_ns, 30))
        other.clean([])
    assert position.segment < int(segments(folder)[-1].stem)
    for one in logged_packets(folder):
        packet = one.packet
        assert packet.payload == entry(packet.time_ns or 0, len(packet.payload)).packet.payload


def test_oldest_segment_is_given_up_and_reported_if_the_recorder_is_too_late(small: Logging, folder: Path) -> None:
    expect_recorder(folder)
    log = small(most_unrecorded_bytes=2000)
    kept = []
    for time_ns in range(1, 100):
        log.append(entry(time_ns, 40))
        kept.append(log.clean([]))
    assert kept[0]
    assert not all(kept)
    SYNCER.now(SYNCED_WITHIN_S)  # Windows frees a segment once it is on the disk
    log.clean([])
    assert sum(file.stat().st_size for file in segments(folder)) <= 2000 + 6 * SMALL_SEGMENT
    assert times(folder)[-1] == 99


def test_without_a_recorder_the_log_stays_small(small: Logging, folder: Path) -> None:
    log = small()
    for time_ns in range(1, 200):
        log.append(entry(time_ns, 40))
        assert log.clean([])
    SYNCER.now(SYNCED_WITHIN_S)  # Windows frees a segment once it is on the disk
    assert log.clean([])
    assert len(segments(folder)) <= 6


def test_a_segment_that_can_not_be_freed_yet_is_freed_later(
    small: Logging, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def held_open(path: Path, target: Path) -> Path:
        raise PermissionError(13, "another process is using this file", str(path))

    log = small()
    with monkeypatch.context() as windows:
        windows.setattr(Path, "replace", held_open)
        for time_ns in range(1, 200):
            log.append(entry(time_ns, 40))
            assert log.clean([])
        assert len(segments(folder)) > 20
    assert log.clean([])
    assert len(segments(folder)) <= 6


def test_a_full_disk_is_not_filled_with_files_nor_with_halves(logging: Logging, folder: Path) -> None:
    log = logging()
    log.append(entry(1))
    (file,) = folder.iterdir()
    with file_limit(file.stat().st_size + 3):
        for time_ns in range(2, 20):
            with pytest.raises(OSError, match="File too large"):
                log.append(entry(time_ns))
    assert len(list(folder.iterdir())) == 1
    log.append(entry(20))
    assert times(folder) == [1, 20]


# --- following it ---


def test_a_reader_follows_the_log_over_segments_and_lives(small: Logging, folder: Path) -> None:
    reader = LogReader(folder)
    assert reader.read(1000) == []
    found = []
    for life in range(3):
        log = small()
        for time_ns in range(life * 20 + 1, life * 20 + 21):
            log.append(entry(time_ns, 40))
            if time_ns % 3 == 0:
                found += [one.packet.time_ns for one, _ in reader.read(1000)]
    found += [one.packet.time_ns for one, _ in reader.read(1 << 20)]
    assert found == list(range(1, 61))


def test_reader_continues_at_the_position_of_another(small: Logging, folder: Path) -> None:
    log = small()
    for time_ns in range(1, 30):
        log.append(entry(time_ns, 40))
    for one, position in LogReader(folder).read(1 << 20):
        (following, *_) = [*LogReader(folder, position).read(1), (entry(30), START)]
        assert following[0].packet.time_ns == (one.packet.time_ns or 0) + 1


def test_a_reader_waits_for_the_rest_of_a_packet(logging: Logging, folder: Path) -> None:
    log = logging()
    log.append(entry(1, 100))
    (segment,) = segments(folder)
    whole = segment.read_bytes()
    segment.write_bytes(whole[:-1])
    reader = LogReader(folder)
    assert reader.read(1000) == []
    segment.write_bytes(whole)
    assert [one.packet.time_ns for one, _ in reader.read(1000)] == [1]


def test_a_reader_of_segments_that_are_gone_goes_on_with_the_oldest_there_is(small: Logging, folder: Path) -> None:
    log = small()
    for time_ns in range(1, 60):
        log.append(entry(time_ns, 40))
    reader = LogReader(folder)
    reader.read(1)
    SYNCER.now(SYNCED_WITHIN_S)  # Windows removes no open file
    for file in segments(folder)[:3]:
        file.unlink()
    found = [one.packet.time_ns for one, _ in reader.read(1 << 20)]
    assert found == times(folder)


def test_committed_position_exists_from_the_beginning(folder: Path) -> None:
    assert committed(folder) is None
    expect_recorder(folder)
    assert committed(folder) == START
    commit(folder, Position(3, 17))
    expect_recorder(folder)
    assert committed(folder) == Position(3, 17)
    (folder / packet_log.COMMITTED_FILE).write_text("half a num")
    assert committed(folder) == START


def test_fully_recorded_log_is_removed_after_the_end(logging: Logging, folder: Path) -> None:
    expect_recorder(folder)
    log = logging()
    log.append(entry(1))
    log.close()
    discard_if_recorded(folder)
    assert times(folder) == [1], "it is not recorded"
    commit_all(folder)
    discard_if_recorded(folder)
    assert not folder.exists()


def test_the_offset_of_a_packet_is_where_the_next_begins(logging: Logging, folder: Path) -> None:
    log = logging()
    for time_ns in range(1, 4):
        log.append(entry(time_ns))
    offsets = [offset for _, offset in read_segment(path_of(folder, 1))]
    assert [one.packet.time_ns for one, _ in read_segment(path_of(folder, 1), offsets[0])] == [2, 3]
