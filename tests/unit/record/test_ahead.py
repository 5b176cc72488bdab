"""What is written down ahead of its publication, until it is recorded."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from afspm.model import Packet
from afspm.record import ahead
from afspm.record.ahead import Ahead, Written, expect_record, recorded_until, say_recorded, written_ahead

Noting = Callable[..., Ahead]


def packet(time_ns: int, size: int = 10, envelope: str = "Scan2d_1.0_Height") -> Packet:
    return Packet(envelope, bytes([time_ns % 251]) * size, time_ns)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    expect_record(tmp_path)
    return tmp_path / ahead.RECORDED_FILE


@pytest.fixture
def noting(folder: Path, recorded: Path) -> Iterator[Callable[..., Ahead]]:
    """Makes what notes packets in the folder, another life each time."""
    made: list[Ahead] = []

    def make(**settings: int) -> Ahead:
        made.append(Ahead(folder, recorded, **settings))
        return made[-1]

    yield make
    for one in made:
        one.close(ended=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / f"scheduler{ahead.FOLDER_SUFFIX}"


def test_what_was_noted_is_found_in_order(noting: Noting, folder: Path, recorded: Path) -> None:
    noted = noting()
    wanted = []
    for time_ns, source_ns, cached, size in ((1, 1, True, 0), (2, None, True, 10), (5, 4, False, 200_000)):
        assert noted.note(packet(time_ns, size), source_ns, cached=cached)
        wanted.append(Written(packet(time_ns, size), source_ns, cached))
    assert list(written_ahead(folder)) == wanted, "before it is closed: a kill closes nothing"
    assert list(written_ahead(folder, 2)) == wanted[2:]
    assert ahead.folders(folder.parent) == [folder]


def test_what_a_kill_cut_off_was_not_published(noting: Noting, folder: Path, recorded: Path) -> None:
    noted = noting()
    for time_ns in (1, 2):
        noted.note(packet(time_ns), None, cached=True)
    (segment,) = folder.iterdir()
    whole = segment.read_bytes()
    for length in range(len(whole)):
        segment.write_bytes(whole[:length])
        assert [written.packet.time_ns for written in written_ahead(folder)] == (
            [1] if length >= len(whole) // 2 else []
        )


def test_another_life_goes_on_in_another_file(noting: Noting, folder: Path, recorded: Path) -> None:
    noting().note(packet(1), None, cached=True)
    with (folder / "00000001.packets").open("ab") as file:
        file.write(b"AFp1 half")
    noting().note(packet(2), None, cached=True)
    assert [written.packet.time_ns for written in written_ahead(folder)] == [1, 2]


def test_what_is_recorded_is_given_up_a_file_at_a_time(
    noting: Noting, folder: Path, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "SEGMENT_BYTES", 100)
    noted = noting()
    for time_ns in range(1, 10):
        noted.note(packet(time_ns, 40), None, cached=True)
    assert len(list(written_ahead(folder))) == 9
    say_recorded(recorded, 5)
    for time_ns in range(10, 13):
        noted.note(packet(time_ns, 40), None, cached=True)
    times = [written.packet.time_ns for written in written_ahead(folder)]
    assert times[-7:] == [6, 7, 8, 9, 10, 11, 12]
    assert times[0] is not None
    assert times[0] > 2, times


def test_files_of_which_all_is_recorded_are_written_over(
    noting: Noting, folder: Path, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "SEGMENT_BYTES", 300)
    noted = noting()
    for time_ns in range(1, 60):
        noted.note(packet(time_ns, 40), None, cached=True)
        if time_ns > 4:
            say_recorded(recorded, time_ns - 4)
    assert len(list(folder.iterdir())) <= 4
    times = [written.packet.time_ns or 0 for written in written_ahead(folder)]
    assert times == list(range(times[0], 60)), "what was in the files before is not found again"
    assert times[0] <= 56


def test_another_life_does_not_take_what_was_written_over_for_new(
    noting: Noting, folder: Path, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "SEGMENT_BYTES", 300)
    noted = noting()
    for time_ns in range(1, 13):
        noted.note(packet(time_ns, 40), None, cached=True)
        say_recorded(recorded, time_ns)
    noted.close(ended=False)
    other = noting()
    for time_ns in range(13, 17):
        other.note(packet(time_ns, 30), None, cached=True)
    assert [written.packet.time_ns for written in written_ahead(folder, 12)] == [13, 14, 15, 16]
    assert not [
        w
        for w in written_ahead(folder)
        if w.packet.payload != packet(w.packet.time_ns or 0, len(w.packet.payload)).payload
    ]


@pytest.mark.parametrize("size", [40, 100_000], ids=("small", "large"))
def test_what_a_power_cut_left_half_new_and_half_old_was_not_kept(
    noting: Noting, folder: Path, recorded: Path, size: int
) -> None:
    noted = noting()
    for time_ns in (1, 2):
        noted.note(packet(time_ns, size), None, cached=True)
    (segment,) = folder.iterdir()
    whole = segment.read_bytes()
    for at in range(len(whole) // 2, len(whole), max(1, size // 50)):
        segment.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        assert [written.packet.time_ns for written in written_ahead(folder)] == [1], at
    segment.write_bytes(whole)
    assert [written.packet.time_ns for written in written_ahead(folder)] == [1, 2]


def test_no_more_than_a_bound_waits_and_it_is_said(
    noting: Noting, folder: Path, recorded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ahead, "SEGMENT_BYTES", 100)
    noted = noting(most_bytes=500)
    kept = [noted.note(packet(time_ns, 40), None, cached=True) for time_ns in range(1, 20)]
    assert kept[0]
    assert not kept[-1]
    assert sum(file.stat().st_size for file in folder.iterdir()) <= 500
    say_recorded(recorded, 19)
    assert noted.note(packet(20), None, cached=True), "there is room again"


def test_a_full_disk_is_not_filled_with_files_nor_with_halves(noting: Noting, folder: Path) -> None:
    noted = noting()
    noted.note(packet(1), None, cached=True)
    segment = noted._segment
    assert segment is not None
    real = segment._file

    class Full:
        """Has room for a few bytes more."""

        def write(self, data: memoryview) -> int:
            real.write(data[:3])
            raise OSError(errno.ENOSPC, "No space left on device")

        def __getattr__(self, name: str) -> Any:
            return getattr(real, name)

    segment._file = Full()  # type: ignore[assignment]
    for time_ns in range(2, 20):
        with pytest.raises(OSError, match="No space"):
            noted.note(packet(time_ns), None, cached=True)
    assert len(list(folder.iterdir())) == 1
    segment._file = real
    noted.note(packet(20), None, cached=True)
    assert [written.packet.time_ns for written in written_ahead(folder)] == [1, 20]


def test_at_the_end_nothing_is_left_if_all_is_recorded(noting: Noting, folder: Path, recorded: Path) -> None:
    noted = noting()
    noted.note(packet(1), None, cached=True)
    say_recorded(recorded, 1)
    noted.close(ended=True)
    assert not folder.exists()


def test_at_the_end_what_is_not_recorded_stays(noting: Noting, folder: Path, recorded: Path) -> None:
    noted = noting()
    noted.note(packet(7), None, cached=True)
    noted.close(ended=True)
    assert [written.packet.time_ns for written in written_ahead(folder)] == [7]


def test_until_when_it_is_recorded_is_known_from_the_beginning(tmp_path: Path) -> None:
    file = tmp_path / ahead.RECORDED_FILE
    assert (file.exists(), recorded_until(file)) == (False, -1)
    expect_record(tmp_path)
    assert (file.exists(), recorded_until(file)) == (True, -1)
    say_recorded(file, 17)
    expect_record(tmp_path)
    assert recorded_until(file) == 17
    file.write_text("half a num")
    assert recorded_until(file) == -1
