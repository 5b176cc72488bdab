"""One file of the packet log: packets one after the other, each with its length and a checksum.

A packet is: "AFp3", the number of the file, the lengths of envelope and payload, its time and the translator's time of
it (-1: none), the number of cached packets of its envelope, the checksum of the whole packet; envelope; payload. Keyed
results of components are kept in the same form, in files with the number 0. The checksum of a large payload is the sum
of its 64-bit words, which takes a hundredth of the time of sending them.

Overwriting an old file takes a fraction of the time of a new file. The number of the file, new each time, distinguishes
new packets from remains of old packets; the checksum detects an incomplete packet after a kill or power cut.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from afspm.model import LoggedPacket, Packet
from afspm.storage.disk import SYNCER

SUFFIX = ".packets"
_HEAD = struct.Struct("<4sQIIqqIQ")
_MAGIC = b"AFp3"
_SMALL = 1 << 16
_WORD = 8
_CHECKSUM_MODULUS = 1 << 64


class SegmentWriter:
    """An open file to which the packets of one segment are appended.

    Args:
        spare: an unused file to overwrite; None: a new file.

    Attributes:
        size: bytes of the packets in the file.

    Raises:
        OSError: the disk refuses (full …).
    """

    def __init__(self, path: Path, spare: Path | None = None) -> None:
        if spare is not None:
            spare.replace(path)
        self.path = path
        self.size = 0
        self._number = number_of(path)
        self._file = path.open("xb" if spare is None else "r+b", buffering=0)
        SYNCER.folder_soon(path.parent)

    def append(self, entry: LoggedPacket) -> None:
        """Append a packet.

        Raises:
            OSError: the disk refuses (full …); then call `take_back`.
        """
        payload = entry.packet.payload
        head = head_of(entry, self._number)
        # one system call for a small packet, no copy of a large one
        if len(payload) <= _SMALL:
            self._write(head + payload)
        else:
            self._write(head)
            self._write(payload)
        self.size += len(head) + len(payload)
        SYNCER.soon(self._file.fileno())

    def take_back(self) -> bool:
        """Remove the written part of a failed packet; return whether more packets can be appended."""
        try:
            self._file.seek(self.size)
            self._file.truncate()
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        self._file.close()

    def _write(self, data: bytes | memoryview) -> None:
        # an unbuffered write may take only a part, e.g. on a disk that is nearly full
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) :]


def number_of(path: Path) -> int:
    """Return the number of a segment."""
    return int(path.stem)


def path_of(folder: Path, number: int) -> Path:
    """Return the path of the segment with a number."""
    return folder / f"{number:08d}{SUFFIX}"


def segments(folder: Path) -> list[Path]:
    """Return the segments in a folder, oldest first."""
    return sorted(file for file in folder.glob(f"*{SUFFIX}") if file.stem.isdigit())


def read_segment(path: Path, offset: int = 0) -> Iterator[tuple[LoggedPacket, int]]:
    """Yield each complete packet from an offset on, with the offset after it; nothing if the file is gone."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return
    with file:
        file.seek(offset)
        number = number_of(path)
        while (entry := read_packet(file, number)) is not None:
            yield entry, file.tell()


def read_packet(file: IO[bytes], number: int = 0) -> LoggedPacket | None:
    """Return the packet at the present offset; None without a complete packet."""
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    # a number of another life marks remains of an overwritten file
    magic, written_number, envelope_len, payload_len, time_ns, source_ns, history, _ = _HEAD.unpack(head)
    if (magic, written_number) != (_MAGIC, number):
        return None
    envelope, payload = file.read(envelope_len), file.read(payload_len)
    packet = Packet(envelope.decode("utf-8", "replace"), payload, None if time_ns < 0 else time_ns)
    entry = LoggedPacket(packet, None if source_ns < 0 else source_ns, history)
    is_whole = len(payload) == payload_len and head_of(entry, number) == head + envelope
    return entry if is_whole else None


def head_of(entry: LoggedPacket, number: int = 0) -> bytes:
    """Return the bytes of a packet before its payload."""
    packet, source_ns, history = entry
    envelope, times = packet.envelope.encode(), [-1 if one is None else one for one in (packet.time_ns, source_ns)]
    about = _MAGIC, number, len(envelope), len(packet.payload), *times, history
    named = zlib.crc32(_HEAD.pack(*about, 0) + envelope)
    return _HEAD.pack(*about, (named + _checksum(packet.payload)) % _CHECKSUM_MODULUS) + envelope


def _checksum(payload: bytes | memoryview) -> int:
    if len(payload) <= _SMALL:
        return zlib.crc32(payload)
    import numpy as np  # imported late: without numpy a scheduler starts in half the time

    words, rest = divmod(len(payload), _WORD)
    end = int.from_bytes(payload[len(payload) - rest :], "little")
    return int(np.add.reduce(np.frombuffer(payload, "<u8", words), dtype=np.uint64)) + end
