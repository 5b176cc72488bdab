"""The packet log: every published packet of the scheduler, appended before its publication.

The log is the only source of truth about these packets. A restarted scheduler reads its cache from it, the recorder
follows it, and the record (HDF5 files and an SQLite journal) derives from it. An appended packet goes to the system at
once, so that it survives a kill of all processes; a moment later it is on the disk, and survives a power cut (see
`disk`).

The log is bounded. The recorder commits the position up to which all packets are in the record and on the disk.
If the log is too large, segments before that position are overwritten, after the packets that the scheduler still
caches have been appended again.
"""

from __future__ import annotations

import contextlib
import sys
from collections import deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from afspm.model import LoggedPacket
from afspm.storage.atomic import replace_file
from afspm.storage.disk import SYNCER
from afspm.storage.segment import SUFFIX, SegmentWriter, number_of, path_of, read_segment, segments

LOG_FOLDER = "packets"
"""Folder of the log, in the state folder of a run."""
COMMITTED_FILE = "recorded"
"""File in the log's folder with the committed position, if there is a recorder."""
SEGMENT_BYTES = 16 << 20
CAPACITY_BYTES = 64 << 20
MOST_UNRECORDED_BYTES = 1 << 30  # beyond the usual size; above it unrecorded packets are dropped
SPARE_BYTES = 256 << 20
"""Largest size of all spare files together, enough for a flood of packets until it is recorded."""
SYNCED_WITHIN_S = 5.0  # for a disk that hangs: then the log goes on without it
_SPARE_SUFFIX = ".spare"


class Position(NamedTuple):
    """A place between two packets of a log."""

    segment: int
    offset: int


START = Position(0, 0)


class PacketLog:
    """A writer of packets. One process writes a log; any number of processes may read it meanwhile.

    Args:
        folder: created with the first packet.
        most_unrecorded_bytes: largest growth of the log above its usual size while packets wait for the recorder; above
            it the oldest packets are dropped.
        segment_bytes: size of one file, after which the next begins.
        capacity_bytes: size up to which no segment is freed; twice the size of the cached packets, if that is larger.

    Attributes:
        has_grown: whether a segment was filled since the last `clean`; True before the first `clean`.
    """

    def __init__(
        self,
        folder: Path,
        *,
        most_unrecorded_bytes: int = MOST_UNRECORDED_BYTES,
        segment_bytes: int = SEGMENT_BYTES,
        capacity_bytes: int = CAPACITY_BYTES,
    ) -> None:
        self._folder = folder
        self._segment_bytes, self._capacity_bytes = segment_bytes, capacity_bytes
        self._most_unrecorded_bytes = most_unrecorded_bytes
        self._segment: SegmentWriter | None = None
        self._full = deque((path, path.stat().st_size) for path in segments(folder))
        self._done_with: list[Path] = []
        self._spare = sorted(folder.glob(f"*{_SPARE_SUFFIX}"))
        # numbers are never used twice: they distinguish new packets from remains in an overwritten file
        used = [number_of(path) for path in (*self._spare, *(path for path, _ in self._full))]
        self._number = max([*used, (committed(folder) or START).segment])
        self.has_grown = True

    def append(self, entry: LoggedPacket) -> None:
        """Append a packet, so that it survives a kill.

        Raises:
            OSError: the disk refuses (full …); then no part of the packet is in the log.
        """
        if self._segment is not None and self._segment.size >= self._segment_bytes:
            self.close()
        segment = self._segment = self._segment or self._opened()
        try:
            segment.append(entry)
        except OSError:
            if not segment.take_back():
                self.close()  # readers skip half a packet at the end of a segment, but not in the middle
            raise

    def clean(self, cached: Iterable[LoggedPacket]) -> bool:
        """Free the oldest segments while the log is too large; packets in `cached` stay in the log.

        Returns:
            False if packets were dropped before they were recorded.

        Raises:
            OSError: the disk is full, or does not sync.
        """
        self.has_grown = False
        live = {entry.packet.time_ns: len(entry.packet.payload) for entry in cached}
        limit = max(self._capacity_bytes, 2 * sum(live.values()))
        recorded = committed(self._folder)
        all_recorded = True
        while self._full and self._size > limit:
            path, _ = self._full[0]
            is_recorded = recorded is None or number_of(path) < recorded.segment
            if not is_recorded and self._size <= limit + self._most_unrecorded_bytes:
                break
            all_recorded = all_recorded and is_recorded
            # before the segment is freed, else a power cut loses the packets
            self._carry_forward(path, live)
            self._full.popleft()
            self._done_with.append(path)
        self._free()
        return all_recorded

    def close(self) -> None:
        """Finish the present segment. Safe to repeat; `append` begins another."""
        if self._segment is not None:
            self._full.append((self._segment.path, self._segment.size))
            self._segment.close()
            self._segment = None
            self.has_grown = True

    @property
    def _size(self) -> int:
        return (self._segment.size if self._segment else 0) + sum(size for _, size in self._full)

    def _opened(self) -> SegmentWriter:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._number += 1
        path = path_of(self._folder, self._number)
        if self._spare:
            with contextlib.suppress(OSError):  # Windows renames no file that a reader has open
                return SegmentWriter(path, self._spare.pop())
        return SegmentWriter(path)

    def _carry_forward(self, path: Path, live: dict[int | None, int]) -> None:
        carried = [entry for entry, _ in read_segment(path) if entry.history and entry.packet.time_ns in live]
        for entry in carried:
            self.append(entry)
        if carried:
            SYNCER.now(SYNCED_WITHIN_S)  # sync the new copy before the old one is overwritten

    def _free(self) -> None:
        # some files are kept as spares to overwrite, which takes a fraction of the time of a new file
        files, self._done_with = self._done_with, []
        for path in files:
            try:
                self._spare.append(path.replace(path.with_suffix(_SPARE_SUFFIX)))
            except OSError:  # Windows renames no file that is open for a read or sync: the next call tries again
                self._done_with.append(path)
        with contextlib.suppress(OSError):
            while len(self._spare) > SPARE_BYTES // self._segment_bytes:
                self._spare[0].unlink()
                del self._spare[0]


class LogReader:
    """A reader that follows a log while it is written.

    Attributes:
        position: position after the last packet read.
        newest: number of the newest segment at the last read.
        is_cut: whether the last read stopped at a limit: more packets may be there.
    """

    def __init__(self, folder: Path, position: Position = START) -> None:
        self.position = position
        self.newest = position.segment
        self.is_cut = False
        self._folder = folder

    def read(self, most_bytes: int, most_packets: int = sys.maxsize) -> list[tuple[LoggedPacket, Position]]:
        """Return the next packets, of about `most_bytes` in all, each with the position after it.

        Raises:
            OSError: the log can't be read.
        """
        found: list[tuple[LoggedPacket, Position]] = []
        segment, start = self.position
        self.is_cut = False
        while True:
            later = [number for number in map(number_of, segments(self._folder)) if number > segment]
            self.newest = max(later, default=segment)
            for entry, offset in read_segment(path_of(self._folder, segment), start):
                found.append((entry, Position(segment, offset)))
                most_bytes -= len(entry.packet.payload)
                self.is_cut = most_bytes <= 0 or len(found) >= most_packets
                if self.is_cut:
                    break
            # a segment does not grow once it has a successor
            if self.is_cut or not later:
                self.position = found[-1][1] if found else Position(segment, start)
                return found
            segment, start = later[0], 0


def log_folder(state_dir: Path) -> Path:
    """Return the folder of a run's packet log."""
    return state_dir / LOG_FOLDER


def logged_packets(folder: Path) -> Iterator[LoggedPacket]:
    """Yield all packets of a log in the order of appending; packets carried forward appear twice."""
    for path in segments(folder):
        yield from (entry for entry, _ in read_segment(path))


def cached_packets(folder: Path) -> list[LoggedPacket]:
    """Return the content of the scheduler's cache at the last write, oldest first."""
    kept: dict[str, dict[int, LoggedPacket]] = {}
    for entry in logged_packets(folder):
        if entry.history:
            of_envelope = kept.setdefault(entry.packet.envelope, {})
            of_envelope[entry.packet.time_ns or 0] = entry
            while len(of_envelope) > entry.history:
                del of_envelope[min(of_envelope)]
    entries = (entry for of_envelope in kept.values() for entry in of_envelope.values())
    return sorted(entries, key=lambda entry: entry.packet.time_ns or 0)


def expect_recorder(folder: Path) -> None:
    """Make the log keep packets until a recorder has committed them.

    Raises:
        OSError: the disk refuses.
    """
    if committed(folder) is None:
        folder.mkdir(parents=True, exist_ok=True)
        commit(folder, START)


def commit(folder: Path, position: Position) -> None:
    """Commit a position: all packets before it are recorded and on the disk.

    Raises:
        OSError: the disk refuses.
    """
    text = f"{position.segment} {position.offset}\n"
    replace_file(folder / COMMITTED_FILE, [text.encode("ascii")], synced=False)


def committed(folder: Path) -> Position | None:
    """Return the committed position; None without a recorder."""
    try:
        segment, offset = (folder / COMMITTED_FILE).read_text(encoding="ascii").split()
        return Position(int(segment), int(offset))
    except FileNotFoundError:
        return None
    # a damaged file: nothing counts as recorded, so nothing is freed
    except (OSError, ValueError):
        return START


def discard_if_recorded(folder: Path) -> None:
    """Remove the log of an ended experiment, unless a recorder has not recorded all of it yet.

    Raises:
        OSError: the log can't be read.
    """
    position = committed(folder)
    if position is not None and LogReader(folder, position).read(1):
        return
    with contextlib.suppress(OSError):
        SYNCER.now(SYNCED_WITHIN_S)  # Windows removes no open file: let the syncer close its descriptors
    for pattern in (f"*{SUFFIX}", f"*{_SPARE_SUFFIX}", COMMITTED_FILE):
        for file in folder.glob(pattern):
            with contextlib.suppress(OSError):
                file.unlink()
    with contextlib.suppress(OSError):
        folder.rmdir()
