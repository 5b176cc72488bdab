"""What is published is written down ahead of it, until it is in the record: then a kill loses nothing of it.

The scheduler, which alone knows what is published under which envelope at what time, appends each packet to a file
before it goes out (see `segments`). That is handed to the system, and outlives a kill of all processes; a moment later
it is on the disk, and outlives a power cut (see `disk`). The recorder says up to which time everything is in the record
and on disk; files that have nothing newer are written over. What a kill has cut off at the end of a file was not
published.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from afspm.model import Packet
from afspm.record.segments import SUFFIX, Segment, Written, number_of, read, segments
from afspm.storage.atomic import replace_file

__all__ = ["Ahead", "Written", "expect_record", "folders", "recorded_until", "say_recorded", "written_ahead"]

RECORDED_FILE = "recorded"
"""In the state folder: the time, in ns, up to which everything is in the record. It is there if there is a record."""
FOLDER_SUFFIX = ".ahead"
SEGMENT_BYTES = 16 << 20
MOST_BYTES = 1 << 30
SPARE_BYTES = 256 << 20
"""As much is kept to be written over. What is recorded is sure a few seconds later (see `components.recording`): so
these are enough for some 40 MB/s, all that microscopes deliver and more."""
SPARE_SUFFIX = ".spare"


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
        self._segment: Segment | None = None
        self._full: list[tuple[Path, int, int]] = []  # file, bytes written to it, newest time
        self._spare = sorted(folder.glob(f"*{SPARE_SUFFIX}"))
        for file in segments(folder):
            found = [(written.size, written.packet.time_ns or 0) for written in read(file)]
            self._full.append((file, sum(size for size, _ in found), max((t for _, t in found), default=0)))

    def note(self, packet: Packet, source_ns: int | None, *, cached: bool) -> bool:
        """Write a packet down; False: too much waits to be recorded, and it was not.

        Raises:
            OSError: the disk is full …
        """
        written = Written(packet, source_ns, cached)
        size = written.size
        if (self._segment and self._segment.size >= SEGMENT_BYTES) or self._waiting + size > self._most_bytes:
            self._begin_another()
        if self._waiting + size > self._most_bytes:
            return False
        segment = self._segment = self._segment or self._opened()
        try:
            segment.append(written)
        except OSError:
            if not segment.take_back():
                self._finish()  # half a packet at the end of a file is no harm, in the middle it would be
            raise
        return True

    @property
    def _waiting(self) -> int:
        """Bytes that may not be written over."""
        return (self._segment.size if self._segment else 0) + sum(size for _, size, _ in self._full)

    def close(self, *, ended: bool) -> None:
        """Nothing more comes; if the experiment has ended and all is recorded, nothing is left."""
        self._finish()
        if ended:
            self._spare_recorded()
            self._delete(self._spare)
            with contextlib.suppress(OSError):
                self._folder.rmdir()

    def _opened(self) -> Segment:
        self._folder.mkdir(parents=True, exist_ok=True)
        there = [*segments(self._folder), *self._folder.glob(f"*{SPARE_SUFFIX}")]  # no number is there twice
        path = self._folder / f"{max(map(number_of, there), default=0) + 1:08d}{SUFFIX}"
        if self._spare:
            with contextlib.suppress(OSError):  # somebody still reads it, where such files can't be renamed
                return Segment(path, self._spare.pop())
        return Segment(path)

    def _begin_another(self) -> None:
        self._finish()
        self._spare_recorded()

    def _finish(self) -> None:
        if self._segment is not None:
            self._full.append((self._segment.path, self._segment.size, self._segment.newest_ns))
            self._segment.close()
            self._segment = None

    def _spare_recorded(self) -> None:
        """Files of which all is in the record may be written over; too many are deleted."""
        until_ns = recorded_until(self._recorded)
        over, self._full = ([f for f in self._full if (f[2] <= until_ns) is is_over] for is_over in (True, False))
        for file, _, _ in over:
            spare = file.with_suffix(SPARE_SUFFIX)
            with contextlib.suppress(OSError):
                self._spare.append(file.replace(spare))
        kept = SPARE_BYTES // SEGMENT_BYTES
        self._delete(self._spare[:-kept])
        self._spare = self._spare[-kept:]

    def _delete(self, files: list[Path]) -> None:
        for file in files:
            with contextlib.suppress(OSError):
                file.unlink()


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
    replace_file(file, [f"{time_ns}\n".encode("ascii")], synced=False)


def written_ahead(folder: Path, since_ns: int = -1) -> Iterator[Written]:
    """What was written down in a folder and is newer, in the order in which it was published."""
    for file in segments(folder):
        yield from (written for written in read(file) if (written.packet.time_ns or 0) > since_ns)


def folders(state_dir: Path) -> list[Path]:
    """Of all schedulers of a run."""
    return sorted(folder for folder in state_dir.glob(f"*{FOLDER_SUFFIX}") if folder.is_dir())
