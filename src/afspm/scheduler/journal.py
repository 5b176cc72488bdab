"""The cache on disk, so that a killed scheduler finds it again.

A folder with one file a packet, which follows what is cached: a thread writes what is new and deletes what went, some
time after it happened. What was not written yet when the scheduler was killed the translator still has, and sends it
again. What the scheduler itself publishes nobody else has: that is written before it is published.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Iterable
from pathlib import Path

from afspm.clock import Clock
from afspm.model import Packet
from afspm.record.ahead import FOLDER_SUFFIX, RECORDED_FILE, Ahead, written_ahead
from afspm.storage.atomic import replace_file

_PERIOD_S = 0.05
_TIDY_S = 2.0  # where all is written, and only what is no longer cached is still to be deleted
# the thread may take this part of the time at most, so that a flood of large scans is not slowed down by the disk
_SHARE = 0.1
_SUFFIX = ".packet"
_COMPLAIN_EVERY_S = 60.0

Entry = tuple[Packet, int | None]
"""A packet as it was published, and the time that the translator gave it."""


class Journal:
    """Keeps a folder like the cache.

    Args:
        folder: None: nothing is kept.
    """

    def __init__(self, folder: Path | None, clock: Clock, log: logging.Logger) -> None:
        recorded = folder.parent / RECORDED_FILE if folder else None
        self._ahead: Ahead | None = None
        if folder is not None and recorded is not None and recorded.exists():
            self._ahead = Ahead(folder.with_suffix(FOLDER_SUFFIX), recorded)
        self._folder = folder
        self._clock = clock
        self._log = log
        self._due_s: float | None = None
        self._not_before_s = 0.0
        self._wanted: tuple[Entry, ...] | None = None
        self._written: set[int] = set()
        self._condition = threading.Condition()
        self._closing = False
        self._failing = False
        self._complain_at_s = 0.0
        self._thread: threading.Thread | None = None

    def load(self) -> list[Entry]:
        """Return the cached packets, oldest first. Damaged files are logged and deleted."""
        if self._folder is None:
            return []
        entries: list[Entry] = []
        for file in sorted(self._folder.iterdir()) if self._folder.is_dir() else ():
            entry = _read(file) if file.suffix == _SUFFIX else None
            if entry is not None and entry[0].time_ns is not None:
                entries.append(entry)
                self._written.add(entry[0].time_ns)
                continue
            if file.suffix == _SUFFIX:
                self._log.warning("deleted a damaged packet of the cache: %s", file)
            file.unlink(missing_ok=True)
        return self._with_ahead(self._folder, entries)

    def _with_ahead(self, folder: Path, entries: list[Entry]) -> list[Entry]:
        """With what was published after the thread had written last."""
        found = {packet.time_ns or 0: (packet, source_ns) for packet, source_ns in entries}
        newest_ns = max((packet.time_ns or 0 for packet, source_ns in entries if source_ns is not None), default=-1)
        for written in written_ahead(folder.with_suffix(FOLDER_SUFFIX), newest_ns):
            if written.cached:
                found.setdefault(written.packet.time_ns or 0, (written.packet, written.source_ns))
        return [found[time_ns] for time_ns in sorted(found)]

    def note(self, packet: Packet, source_ns: int | None, *, cached: bool) -> None:
        """A packet is about to be published: with a time of the translator, or as the scheduler's own."""
        self._write_ahead(packet, source_ns, cached=cached)
        # only then: whoever finds it in the cache publishes it, and then it has to be in the record
        if cached and source_ns is None:
            self._keep(packet)
        elif cached:
            self._is_due_in(_PERIOD_S)

    def _write_ahead(self, packet: Packet, source_ns: int | None, *, cached: bool) -> None:
        if self._ahead is None:
            return
        try:
            kept = self._ahead.note(packet, source_ns, cached=cached)
            complaint = "" if kept else "the recorder does not keep up"
        except OSError as error:
            complaint = str(error)
        if complaint and self._clock.monotonic_s() >= self._complain_at_s:
            self._complain_at_s = self._clock.monotonic_s() + _COMPLAIN_EVERY_S
            self._log.critical("what is published now would be lost in a power cut: %s", complaint)

    def _keep(self, packet: Packet) -> None:
        """Write a packet of the scheduler's own at once; it is newer than all that is cached."""
        if self._folder is None or packet.time_ns is None:
            return
        self._is_due_in(_TIDY_S)  # for what it takes the place of
        try:
            _store(self._folder / _name(packet.time_ns), packet, None)
            self._written.add(packet.time_ns)
        except OSError as error:
            self._tell(error)

    def _is_due_in(self, period_s: float) -> None:
        if self._folder is None or (self._due_s is not None and period_s >= _TIDY_S):
            return
        due_s = max(self._clock.monotonic_s() + period_s, self._not_before_s)
        self._due_s = due_s if self._due_s is None else min(self._due_s, due_s)

    @property
    def due_s(self) -> float | None:
        """When, in real monotonic time, `follow` should be called; None: nothing has changed."""
        return self._due_s

    def follow(self, cached: Iterable[Entry]) -> None:
        """Make the folder hold exactly `cached`, in a while and in another thread."""
        self._due_s = None
        with self._condition:
            self._wanted = tuple(cached)
            self._condition.notify()
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
            self._thread.start()

    def close(self, *, ended: bool = False) -> None:
        """Write what is still to be written. Safe to repeat."""
        if self._ahead is not None:
            self._ahead.close(ended=ended)
        with self._condition:
            self._closing = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._wanted is not None or self._closing)
                wanted, self._wanted = self._wanted, None
            if wanted is None:
                return
            began_s = self._clock.monotonic_s()
            try:
                self._write(wanted)
                self._failing = False
            except OSError as error:
                self._tell(error)
            now_s = self._clock.monotonic_s()
            self._not_before_s = now_s + (now_s - began_s) / _SHARE

    def _tell(self, error: OSError) -> None:
        if not self._failing:  # once, not with every packet
            self._log.critical("the cache is not kept, a restarted scheduler will miss scans: %s", error)
        self._failing = True

    def _write(self, wanted: tuple[Entry, ...]) -> None:
        folder = self._folder
        if folder is None:
            return
        times = {packet.time_ns for packet, _ in wanted if packet.time_ns is not None}
        newest_ns = max(times, default=0)
        for packet, source_ns in wanted:
            if packet.time_ns is not None and packet.time_ns not in self._written:
                _store(folder / _name(packet.time_ns), packet, source_ns)
                self._written.add(packet.time_ns)
        # after the new ones: a kill in between leaves too much rather than too little
        for time_ns in [time_ns for time_ns in self._written - times if time_ns <= newest_ns]:  # newer ones were kept
            (folder / _name(time_ns)).unlink(missing_ok=True)
            self._written.discard(time_ns)


def _name(time_ns: int) -> str:
    return f"{time_ns:020d}{_SUFFIX}"


def _store(file: Path, packet: Packet, source_ns: int | None) -> None:
    """A line of JSON about the packet, then its payload as it is."""
    about = {
        "envelope": packet.envelope,
        "time_ns": packet.time_ns,
        "source_ns": source_ns,
        "bytes": len(packet.payload),
    }
    replace_file(file, [json.dumps(about).encode() + b"\n", packet.payload], synced=False)


def _read(file: Path) -> Entry | None:
    """None: not what `_store` wrote."""
    try:
        line, payload = file.read_bytes().split(b"\n", 1)
        about = json.loads(line)
        packet = Packet(str(about["envelope"]), payload, int(about["time_ns"]))
        source_ns = None if about["source_ns"] is None else int(about["source_ns"])
        whole = len(payload) == int(about["bytes"]) and file.name == _name(packet.time_ns or 0)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return (packet, source_ns) if whole else None
