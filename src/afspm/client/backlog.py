"""Queue of the packets that wait for their handlers: in order, without loss, in bounded memory."""

from __future__ import annotations

from collections import deque
from typing import IO

from afspm.basics.errors import FileError
from afspm.model import LoggedPacket, Packet
from afspm.storage.segment import head_of, read_packet

MEMORY_LIMIT_BYTES = 256 << 20  # of packets that a slow component has not handled; more wait in a file


class PacketBacklog:
    """A queue of packets; beyond `limit_bytes`, packets wait in a temporary file, which is removed once empty."""

    def __init__(self, limit_bytes: int = MEMORY_LIMIT_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._memory: deque[Packet] = deque()
        self._memory_bytes = 0
        self._file: IO[bytes] | None = None
        self._read_at = 0
        self._on_disk = 0

    def __len__(self) -> int:
        return len(self._memory) + self._on_disk

    def put(self, packet: Packet) -> None:
        size = len(packet.payload)
        # while packets wait on disk, later ones must too, or they would overtake them
        if self._file is None and (not self._memory or self._memory_bytes + size <= self._limit_bytes):
            self._memory.append(packet)
            self._memory_bytes += size
            return
        if self._file is None:
            import tempfile  # imported late: few processes are ever so far behind

            self._file = tempfile.TemporaryFile(prefix="afspm-")  # noqa: SIM115 - open for as long as it is needed
        self._file.seek(0, 2)
        self._file.write(head_of(LoggedPacket(packet, None, 0)))
        self._file.write(packet.payload)
        self._on_disk += 1

    def take(self) -> Packet | None:
        if self._memory:
            packet = self._memory.popleft()
            self._memory_bytes -= len(packet.payload)
            return packet
        if self._file is None:
            return None
        self._file.seek(self._read_at)
        entry = read_packet(self._file)
        if entry is None:
            raise FileError("a packet that waited on disk can't be read", where="the temporary folder")
        self._read_at = self._file.tell()
        self._on_disk -= 1
        if self._on_disk == 0:
            self.close()
        return entry.packet

    def close(self) -> None:
        """Drop all packets."""
        self._memory.clear()
        self._memory_bytes = self._on_disk = self._read_at = 0
        if self._file is not None:
            self._file.close()
            self._file = None
