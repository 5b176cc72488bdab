"""What is published is written down ahead of it, until it is in the record: then a power cut loses nothing of it.

The scheduler, which alone knows what is published under which envelope at what time, appends each packet to a file
before it goes out. That is handed to the system and not waited for: it outlives a kill of all processes. The recorder
says up to which time everything is in the record and on disk; what is older than that is deleted, a file at a time.

A file is packets one after the other, each: "AFp1", the lengths of envelope and payload, its time, the translator's
time of it, whether it is cached; envelope; payload; a newline. What a kill has cut off at its end was not published.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from afspm.model import Packet
from afspm.record.whole import replace

RECORDED_FILE = "recorded"
"""In the state folder: the time, in ns, up to which everything is in the record. It is there if there is a record."""
FOLDER_SUFFIX = ".ahead"
SEGMENT_BYTES = 16 << 20
MOST_BYTES = 1 << 30

_HEAD = struct.Struct("<4sIIqqB")
_MAGIC = b"AFp1"
_END = b"\n"
_SMALL = 1 << 16


class Written(NamedTuple):
    """A packet as it was published.

    Attributes:
        source_ns: the time that the translator gave it; None: it is the scheduler's own.
        cached: whether it was kept for those who come late.
    """

    packet: Packet
    source_ns: int | None
    cached: bool


class Ahead:
    """Writes packets down before they are published.

    Args:
        folder: made when the first is written.
        recorded: the file with the time up to which everything is recorded.
        most_bytes: how much may wait to be recorded. What is beyond is published all the same.
    """

    def __init__(self, folder: Path, recorded: Path, *, most_bytes: int = MOST_BYTES) -> None:
        self._folder = folder
        self._recorded = recorded
        self._most_bytes = most_bytes
        self._file: IO[bytes] | None = None
        self._size = 0
        self._newest_ns = 0
        self._full: list[tuple[Path, int, int]] = []  # file, size, newest time
        for file in _segments(folder):
            times = [written.packet.time_ns or 0 for written in _read(file)]
            self._full.append((file, file.stat().st_size, max(times, default=0)))

    def note(self, packet: Packet, source_ns: int | None, *, cached: bool) -> bool:
        """Write a packet down; False: too much waits to be recorded, and it was not.

        Raises:
            OSError: the disk is full …
        """
        envelope, time_ns = packet.envelope.encode(), packet.time_ns or 0
        source = -1 if source_ns is None else source_ns
        head = _HEAD.pack(_MAGIC, len(envelope), len(packet.payload), time_ns, source, cached) + envelope
        size = len(head) + len(packet.payload) + len(_END)
        if self._size >= SEGMENT_BYTES or self._waiting + size > self._most_bytes:
            self._begin_another()
        if self._waiting + size > self._most_bytes:
            return False
        if self._file is None:
            self._file = self._opened()
        if len(packet.payload) <= _SMALL:
            self._write(b"".join((head, packet.payload, _END)))
        else:
            self._write(head)
            self._write(packet.payload)
            self._write(_END)
        self._newest_ns = max(self._newest_ns, time_ns)
        return True

    @property
    def _waiting(self) -> int:
        """Bytes that are not deleted."""
        return self._size + sum(size for _, size, _ in self._full)

    def close(self, *, ended: bool) -> None:
        """Nothing more comes; if the experiment has ended and all is recorded, nothing is left."""
        self._finish()
        if ended:
            self._forget_recorded()
            with contextlib.suppress(OSError):
                self._folder.rmdir()

    def _write(self, data: bytes | memoryview) -> None:
        assert self._file is not None
        view = memoryview(data)
        try:
            while view:
                written = self._file.write(view)
                self._size += written
                view = view[written:]
        except OSError:
            self._finish()  # half a packet at the end of a file is no harm, in the middle it would be
            raise

    def _opened(self) -> IO[bytes]:
        self._folder.mkdir(parents=True, exist_ok=True)
        numbers = [int(file.stem) for file in _segments(self._folder)]
        return (self._folder / f"{max(numbers, default=0) + 1:08d}.packets").open("xb", buffering=0)

    def _begin_another(self) -> None:
        self._finish()
        self._forget_recorded()

    def _finish(self) -> None:
        if self._file is not None:
            self._full.append((Path(self._file.name), self._size, self._newest_ns))
            self._file.close()
            self._file, self._size = None, 0

    def _forget_recorded(self) -> None:
        until_ns = recorded_until(self._recorded)
        kept = []
        for file, size, newest_ns in self._full:
            if newest_ns > until_ns:
                kept.append((file, size, newest_ns))
            else:
                with contextlib.suppress(OSError):
                    file.unlink()
        self._full = kept


def recorded_until(file: Path) -> int:
    """The time, in ns, up to which everything is in the record; -1: nothing is."""
    try:
        return int(file.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return -1


def expect_record(state_dir: Path) -> None:
    """There will be a record of this run: what is published is to be kept until it is in it. Raises OSError."""
    file = state_dir / RECORDED_FILE
    if not file.exists():
        say_recorded(file, -1)


def say_recorded(file: Path, time_ns: int) -> None:
    """Everything up to that time is in the record, and on disk. Raises OSError."""
    replace(file, [f"{time_ns}\n".encode("ascii")], synced=False)


def written_ahead(folder: Path, since_ns: int = -1) -> Iterator[Written]:
    """What was written down in a folder and is newer, in the order in which it was published."""
    for file in _segments(folder):
        yield from (written for written in _read(file) if (written.packet.time_ns or 0) > since_ns)


def folders(state_dir: Path) -> list[Path]:
    """Of all schedulers of a run."""
    return sorted(folder for folder in state_dir.glob(f"*{FOLDER_SUFFIX}") if folder.is_dir())


def _segments(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("*.packets") if file.stem.isdigit())


def _read(file: Path) -> Iterator[Written]:
    """The packets of a file, as far as it is whole. One that has been deleted meanwhile is recorded."""
    try:
        stream = file.open("rb")
    except FileNotFoundError:
        return
    with stream:
        while len(head := stream.read(_HEAD.size)) == _HEAD.size:
            magic, envelope_len, payload_len, time_ns, source, cached = _HEAD.unpack(head)
            if magic != _MAGIC:
                return
            envelope, payload, end = stream.read(envelope_len), stream.read(payload_len), stream.read(1)
            if end != _END:
                return
            packet = Packet(envelope.decode("utf-8", "replace"), payload, time_ns)
            yield Written(packet, None if source < 0 else source, bool(cached))
