"""A file of packets one after the other, which is written over again once nobody needs what is in it.

To write where there was something before takes a fraction of what new room on a disk does. What is left of before is
told from what is new by the number of the file, which is new each time, and what a kill or a power cut has left half
by a sum.

A packet is: "AFp2", the number of the file, the lengths of envelope and payload, its time, the translator's time of it
(-1: none), whether it is cached, the sum of all that; envelope; payload. The sum of a large payload is that of its
64-bit words, which takes a hundredth of what it takes to send them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from afspm.model import Packet
from afspm.storage.disk import SYNCER

SUFFIX = ".packets"
_HEAD = struct.Struct("<4sQIIqqBQ")
_MAGIC = b"AFp2"
_SMALL = 1 << 16
_WORD = 8
_MOST = 1 << 64


class Written(NamedTuple):
    """A packet as it was published.

    Attributes:
        source_ns: the time that the translator gave it; None: it is the scheduler's own.
        cached: whether it was kept for those who come late.
    """

    packet: Packet
    source_ns: int | None
    cached: bool

    @property
    def size(self) -> int:
        """In a file, in bytes."""
        packet = self.packet
        return _HEAD.size + len(packet.envelope.encode()) + len(packet.payload)


class Segment:
    """One such file, being written.

    Args:
        spare: a file whose contents nobody needs any more, to write over; None: a new one is made.

    Attributes:
        size: bytes written to it.
        newest_ns: the newest time in it.

    Raises:
        OSError: the disk is full …
    """

    def __init__(self, path: Path, spare: Path | None = None) -> None:
        if spare is not None:
            spare.replace(path)
        self.path = path
        self.size = 0
        self.newest_ns = 0
        self._whole = 0
        self._number = number_of(path)
        self._file = path.open("xb" if spare is None else "r+b", buffering=0)
        SYNCER.folder_soon(path.parent)

    def append(self, written: Written) -> None:
        """Write a packet behind the others. Raises OSError: the disk is full …; it is to be taken back then."""
        payload = written.packet.payload
        head = _head(written, self._number)
        if len(payload) <= _SMALL:
            self._write(head + payload)
        else:
            self._write(head)
            self._write(payload)
        self._whole = self.size
        SYNCER.soon(self._file.fileno())
        self.newest_ns = max(self.newest_ns, written.packet.time_ns or 0)

    def take_back(self) -> bool:
        """Remove what was written of a packet that could not be written as a whole: whether that was possible, so that
        more can be appended."""
        try:
            self._file.seek(self._whole)
            self._file.truncate()
        except OSError:
            return False
        self.size = self._whole
        return True

    def close(self) -> None:
        """Safe to repeat."""
        self._file.close()

    def _write(self, data: bytes | memoryview) -> None:
        view = memoryview(data)
        while view:
            written = self._file.write(view)
            self.size += written
            view = view[written:]


def segments(folder: Path) -> list[Path]:
    """The files of a folder, oldest first."""
    return sorted(file for file in folder.glob(f"*{SUFFIX}") if file.stem.isdigit())


def number_of(path: Path) -> int:
    """What tells a file from what was in it before it had its name."""
    return int(path.stem)


def read(path: Path) -> Iterator[Written]:
    """The packets of a file, as far as they are whole. One that has been written over meanwhile is recorded."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return
    with file:
        number = number_of(path)
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            magic, said, envelope_len, payload_len, time_ns, source, cached, _ = _HEAD.unpack(head)
            if (magic, said) != (_MAGIC, number):
                return
            envelope, payload = file.read(envelope_len), file.read(payload_len)
            packet = Packet(envelope.decode("utf-8", "replace"), payload, time_ns)
            written = Written(packet, None if source < 0 else source, bool(cached))
            if len(payload) < payload_len or _head(written, number) != head + envelope:
                return
            yield written


def _head(written: Written, number: int) -> bytes:
    """What comes before the payload."""
    packet, source_ns, cached = written
    envelope, source = packet.envelope.encode(), -1 if source_ns is None else source_ns
    about = _MAGIC, number, len(envelope), len(packet.payload), packet.time_ns or 0, source, cached
    named = zlib.crc32(_HEAD.pack(*about, 0) + envelope)
    return _HEAD.pack(*about, (named + _sum(packet.payload)) % _MOST) + envelope


def _sum(payload: bytes | memoryview) -> int:
    if len(payload) <= _SMALL:
        return zlib.crc32(payload)
    import numpy as np  # not before there are scans: without it a scheduler starts in half the time

    words, rest = divmod(len(payload), _WORD)
    end = int.from_bytes(payload[len(payload) - rest :], "little")
    return int(np.add.reduce(np.frombuffer(payload, "<u8", words), dtype=np.uint64)) + end
