"""Work for a disk: in order, and with short waits only."""

from __future__ import annotations

import errno
import gc
import os
import sys
import threading
from functools import partial
from pathlib import Path

import pytest
from deadlines import DEADLINE_S

from afspm.storage import disk
from afspm.storage.disk import DiskThread, DiskTimeout, Syncer, run_bounded


class Hanging:
    """Work that lasts until it is released."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.goes_on = threading.Event()

    def hang(self) -> None:
        assert self.goes_on.wait(DEADLINE_S)
        self.done.append("hung")


def test_tasks_run_in_order_and_raise_their_errors() -> None:
    done: list[int] = []
    work = DiskThread()
    for number in range(100):
        work.run(partial(done.append, number))
        assert done[-1] == number
    with pytest.raises(FileNotFoundError):
        work.run(lambda: os.stat("/nowhere"))  # noqa: PTH116
    assert work.close(DEADLINE_S)
    assert done == [*range(100)]


def test_caller_goes_on_while_the_disk_hangs_and_tasks_run_later_in_order() -> None:
    hanging, work = Hanging(), DiskThread(deadline_s=0.01)
    with pytest.raises(DiskTimeout):
        work.run(hanging.hang)
    for name in ("a", "b"):
        with pytest.raises(DiskTimeout):
            work.run(partial(hanging.done.append, name))
    hanging.goes_on.set()
    assert work.close(DEADLINE_S)
    assert hanging.done == ["hung", "a", "b"]
    assert not work.hangs


def test_tasks_for_a_hanging_disk_are_bounded() -> None:
    hanging, work = Hanging(), DiskThread(deadline_s=0.01, most_bytes=100)
    with pytest.raises(DiskTimeout):
        work.run(hanging.hang)
    for size in (60, 60, 30):
        with pytest.raises(DiskTimeout):
            work.run(partial(hanging.done.append, str(size)), size)
    hanging.goes_on.set()
    assert work.close(DEADLINE_S)
    assert hanging.done == ["hung", "60", "30"]


def test_thread_ends_after_its_tasks_once_its_owner_is_gone() -> None:
    before = set(threading.enumerate())
    go_on, done = threading.Event(), list[int]()
    work = DiskThread(deadline_s=0.01)
    with pytest.raises(DiskTimeout):
        work.run(go_on.wait)
    work.submit(lambda: done.append(1))
    assert run_bounded(lambda: 7, 10.0) == 7
    left = set(threading.enumerate()) - before
    del work
    gc.collect()
    go_on.set()
    for thread in left:
        thread.join(60.0)
    assert not any(thread.is_alive() for thread in left)
    assert done == [1]


def test_single_read_has_a_time_limit() -> None:
    hanging = Hanging()
    assert run_bounded(lambda: 7, DEADLINE_S) == 7
    with pytest.raises(DiskTimeout):
        run_bounded(hanging.hang, 0.01)
    hanging.goes_on.set()


class NotingSyncer(Syncer):
    """A syncer that notes the inodes of the files in place of a sync."""

    def __init__(self, period_s: float) -> None:
        self.synced: list[int] = []
        super().__init__(period_s, lambda descriptor: self.synced.append(os.fstat(descriptor).st_ino))


def test_written_data_are_synced_a_moment_later_though_the_file_was_closed(tmp_path: Path) -> None:
    syncer, done = NotingSyncer(period_s=0.01), threading.Event()
    for name in ("a", "b"):
        with (tmp_path / name).open("wb", buffering=0) as file:
            file.write(b"x")
            syncer.soon(file.fileno())
    syncer.folder_soon(tmp_path)
    folder = () if sys.platform == "win32" else (tmp_path,)  # Windows syncs no folders
    wanted = {path.stat().st_ino for path in (tmp_path / "a", tmp_path / "b", *folder)}
    while set(syncer.synced) != wanted and not done.wait(0.01):
        pass


def test_sync_now_waits_for_the_disk(tmp_path: Path) -> None:
    syncer = NotingSyncer(period_s=100.0)
    syncer.now(DEADLINE_S)  # nothing was written
    with (tmp_path / "a").open("wb", buffering=0) as file:
        file.write(b"x")
        syncer.soon(file.fileno())
        syncer.now(DEADLINE_S)
        assert syncer.synced == [os.fstat(file.fileno()).st_ino]


def test_sync_that_hangs_is_not_waited_for(tmp_path: Path) -> None:
    goes_on = threading.Event()

    def hangs(descriptor: int) -> None:
        goes_on.wait(DEADLINE_S)

    syncer = Syncer(100.0, hangs)
    with (tmp_path / "a").open("wb", buffering=0) as file:
        syncer.soon(file.fileno())
        with pytest.raises(DiskTimeout):
            syncer.now(0.01)
    goes_on.set()


def test_sync_that_the_disk_refuses_is_raised_to_the_next_that_waits_and_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    refuses = True

    def sync(descriptor: int) -> None:
        if refuses:
            raise OSError(errno.EIO, "Input/output error")

    caplog.set_level("INFO")
    syncer = Syncer(0.0, sync)
    with (tmp_path / "a").open("wb", buffering=0) as file:
        for _ in range(3):
            syncer.soon(file.fileno())
            with pytest.raises(OSError, match="Input/output error"):
                syncer.now(DEADLINE_S)
        refuses = False
        syncer.now(DEADLINE_S)  # nothing was written since
        syncer.soon(file.fileno())
        syncer.now(DEADLINE_S)
    assert [(record.levelname, record.message) for record in caplog.records] == [
        ("CRITICAL", "the data written in the last moment may be lost in a power cut: [Errno 5] Input/output error"),
        ("INFO", "the disk syncs again"),
    ]


def test_disk_is_full_when_no_scan_has_room_on_it(tmp_path: Path) -> None:
    assert not disk.is_full(tmp_path)
    assert not disk.is_full(tmp_path / "gone")
    assert disk.is_full(tmp_path, least_free=1 << 62)
