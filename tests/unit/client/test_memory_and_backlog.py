"""The memory on disk, and the backlog of packets."""

from __future__ import annotations

import errno
import logging
import os
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from afspm.basics.errors import FileError, InvalidValue
from afspm.client.backlog import PacketBacklog
from afspm.model import Packet
from afspm.storage.memory import Memory


def test_saved_values_survive_a_restart(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "state" / "x.json")
    memory["step"] = 17
    memory["places"] = [[1.5e-9, 2.0]]
    memory.save()
    memory["step"] = 18  # not saved
    assert dict(Memory(tmp_path / "state" / "x.json")) == {"step": 17, "places": [[1.5e-9, 2.0]]}


def test_invalid_value_leaves_nothing_in_memory(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "x.json")
    memory["a"] = 1
    memory.save()
    memory["b"] = object()
    with pytest.raises(InvalidValue, match="can't be kept"):
        memory.save()
    assert dict(Memory(tmp_path / "x.json")) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["x.json"]


def test_numbers_of_numpy_are_kept_and_arrays_are_not(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "x.json")
    memory["n"], memory["sharpness"] = np.int64(3), [np.float32(0.5)]
    memory.save()
    assert dict(Memory(tmp_path / "x.json")) == {"n": 3, "sharpness": [0.5]}
    memory["scan"] = np.zeros((2, 2))
    with pytest.raises(InvalidValue, match="ndarray"):
        memory.save()


def test_changes_are_written_however_deep_they_are_and_nothing_else(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "x.json")
    memory.save_changes()
    assert not (tmp_path / "x.json").exists()
    memory["places"] = [1]
    memory.save_changes()
    memory["places"].append(2)
    memory.save_changes()
    (tmp_path / "x.json").unlink()
    memory.save_changes()
    assert not (tmp_path / "x.json").exists()
    memory.save()
    assert dict(Memory(tmp_path / "x.json")) == {"places": [1, 2]}


def test_key_that_is_not_a_string_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match="text"):
        Memory(None)[5] = "x"  # type: ignore[index]


def test_key_that_is_not_a_string_is_refused_at_any_depth(tmp_path: Path) -> None:
    memory = Memory(tmp_path / "x.json")
    memory["done"] = [{"tiles": {3: True}}]  # read back, it would be {"3": True}, and `3 in …` False
    for save in (memory.save, memory.save_changes):
        with pytest.raises(InvalidValue, match="a key must be a text, not 3"):
            save()


@pytest.mark.parametrize("content", ["{", "[1]", "\0"])
def test_memory_file_of_another_kind_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "x.json").write_text(content)
    with pytest.raises(FileError, match="delete it"):
        Memory(tmp_path / "x.json")


def test_unwritable_folder_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """An unmounted drive must not end a component, which would be given up before the drive is back."""
    drive = tmp_path / "drive"
    drive.mkdir()
    memory = Memory(drive / "x.json")
    drive.rmdir()
    drive.write_text("")
    assert memory.save() is False
    assert [record.levelname for record in caplog.records] == ["CRITICAL"]


def test_memory_on_an_unmounted_drive_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="the folder of the run does not exist"):
        Memory(tmp_path / "away" / "state" / "x.json")


def test_full_disk_is_logged_once_and_all_is_saved_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    caplog.set_level(logging.INFO)
    memory = Memory(tmp_path / "x.json")
    with monkeypatch.context() as disk:
        disk.setattr(os, "fsync", full)
        for step in range(3):
            memory["step"] = step
            assert memory.save() is False
    assert [record.levelname for record in caplog.records] == ["CRITICAL"]
    assert memory.save() is True
    assert dict(Memory(tmp_path / "x.json")) == {"step": 2}
    assert "writing works again" in caplog.text


OPERATIONS = st.lists(st.one_of(st.none(), st.tuples(st.binary(max_size=40), st.none() | st.integers(0, 2**62))))


@given(OPERATIONS)
def test_a_backlog_is_a_queue_however_much_of_it_is_on_disk(operations: list[tuple[bytes, int | None] | None]) -> None:
    backlog, model = PacketBacklog(limit_bytes=60), deque[Packet]()
    for number, operation in enumerate(operations):
        if operation is None:
            assert backlog.take() == (model.popleft() if model else None)
        else:
            packet = Packet(f"Enveloppe_é_{number}", *operation)
            backlog.put(packet)
            model.append(packet)
        assert len(backlog) == len(model)
        assert backlog._memory_bytes <= 60
    while model:
        assert backlog.take() == model.popleft()
    assert backlog._file is None, "an empty backlog keeps no file"
    backlog.close()


def test_a_packet_larger_than_the_limit_is_kept_all_the_same() -> None:
    backlog = PacketBacklog(limit_bytes=10)
    backlog.put(Packet("Scan2d", b"x" * 100, 1))
    backlog.put(Packet("Scan2d", memoryview(b"y" * 100), 2))
    assert [bytes(p.payload[:1]) for p in iter(backlog.take, None)] == [b"x", b"y"]


def test_later_packets_do_not_overtake_those_on_disk() -> None:
    backlog = PacketBacklog(limit_bytes=10)
    for time_ns in range(3):  # the first in memory, the others on disk
        backlog.put(Packet("Scan2d", b"x" * 8, time_ns))
    first = backlog.take()
    backlog.put(Packet("Scan2d", b"x", 3))  # there would be room for it in memory
    assert first is not None
    assert [first.time_ns, *(packet.time_ns for packet in iter(backlog.take, None))] == [0, 1, 2, 3]


@pytest.mark.parametrize("cut", range(1, 13))
def test_power_cut_after_unsynced_saves_leaves_a_generation_before(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "x.json"
    memory = Memory(path)
    for done in (1, 2, 3):
        memory["done"] = done
        assert memory.save(synced=False)
    assert Memory(path)["done"] == 3
    path.write_bytes(path.read_bytes()[:-cut])
    again = Memory(path)
    assert again["done"] == (3 if cut == 1 else 2)
    assert bool(again.damage) == (cut not in (1, 12))
    again["done"] = 4
    assert again.save(synced=False)
    assert Memory(path)["done"] == 4


def test_unsynced_saves_keep_the_memory_file_short(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    memory = Memory(path)
    for done in range(30):
        memory["done"] = f"{done} {100_000 * 'x'}"
        assert memory.save(synced=False)
    assert path.stat().st_size < 1.1 * 2**20
    assert memory.save()
    assert len(path.read_bytes().splitlines()) == 1
    assert Memory(path)["done"].startswith("29 ")
