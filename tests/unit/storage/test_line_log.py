"""The log of requests on a disk that hangs, or is full."""

from __future__ import annotations

import errno
import logging
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from afspm.storage.line_log import LineLog, read_lines

_WRITE = os.write
_LOGGER = logging.getLogger("test")


class Disk:
    """A disk that hangs until it is released, and then does `then` with each write."""

    def __init__(self, then: Callable[[int, bytes], int] = _WRITE) -> None:
        self.answers = threading.Event()
        self.then = then

    def write(self, file: int, text: bytes) -> int:
        self.answers.wait()
        return self.then(file, text)


def test_writer_goes_on_while_the_disk_hangs_and_lines_come_later_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    log, disk = LineLog(tmp_path / "log.jsonl", _LOGGER), Disk()
    monkeypatch.setattr(os, "write", disk.write)
    for number in range(20):  # none of them waits for the disk, or it would wait without end
        log.add(["line", number])
    assert caplog.text.count("requests are recorded late") == 1
    disk.answers.set()
    log.add(["line", 20])
    log.close()
    assert [number for _, number in read_lines(tmp_path / "log.jsonl")] == [*range(21)]


def test_log_has_no_gap_after_a_late_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    log = LineLog(tmp_path / "log.jsonl", _LOGGER)
    log.add(["line", 0])

    def once_full(file: int, text: bytes) -> int:
        disk.then = _WRITE
        raise OSError(errno.ENOSPC, "No space left on device")

    disk = Disk(once_full)
    monkeypatch.setattr(os, "write", disk.write)
    for number in range(1, 4):
        log.add(["line", number])
    disk.answers.set()
    log.close()
    assert [number for _, number in read_lines(tmp_path / "log.jsonl")] == [0]


@pytest.mark.skipif(sys.platform != "linux", reason="needs /dev/full")
def test_full_disk_ends_the_log_once(caplog: pytest.LogCaptureFixture) -> None:
    log = LineLog(Path("/dev/full"), _LOGGER)
    log.add(["line"])
    log.close()
    assert caplog.text.count("requests are no longer recorded") == 1
