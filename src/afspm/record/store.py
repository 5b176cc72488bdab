"""`RecordStore`: the writer of a run's record: the journal, and a file for each scan and spectrum.

The packets of a call are recorded completely or not at all, and a repeated packet is recorded once. For this, files are
written under temporary names, and renamed before the journal's transaction with their names is committed.
"""

from __future__ import annotations

import json
import logging
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from afspm import wire
from afspm.basics.errors import WireError
from afspm.model import (
    ChannelRoles,
    ControlResponse,
    Frame,
    JournalEntries,
    JournalEntry,
    Note,
    Packet,
    ProblemNames,
    ProcessStates,
    Scan,
    ScanLines,
    ScopeStatus,
    Spectrum,
    names,
)
from afspm.model.events import LogLines
from afspm.record import journal, provenance
from afspm.record.journal import SCHEDULER
from afspm.record.measured_files import MeasuredFiles, insert_packet
from afspm.record.scan_assembler import Assembled, ScanAssembler
from afspm.storage.disk import sync_file, sync_folder
from afspm.wire.values import without_values

Image = TypeVar("Image", Scan, ScanLines)

_log = logging.getLogger("afspm.record")
NOTE = "note"
"""The kind of journal entries for notes."""
_ALL_OF_THEM = (OSError, sqlite3.OperationalError)
"""Errors of the disk, which the next write would meet, too."""
_PROCESS = "SELECT role, condition, since_ns, starts, pid, last_exit FROM processes WHERE name = ? ORDER BY rowid DESC"


@dataclass(frozen=True)
class RecordSettings:
    """The settings of a run's record.

    Attributes:
        facts: written into every file: the name of the experiment, seeds …
        problems: the names of the experiment's problems.
        frame: the coordinate frame of published positions; of the sample only where drift is corrected.
        measured: write scans and spectra; otherwise only the journal.
        speed: experiment seconds per real second.
        messages: the types of the user's messages, as `described_types.describe` returns them.
    """

    facts: dict[str, object] = field(default_factory=dict)
    problems: ProblemNames = field(default_factory=ProblemNames)
    frame: Frame = Frame.TIP
    measured: bool = True
    speed: float = 1.0
    messages: dict[str, object] = field(default_factory=dict)


class RecordStore:
    """The record of one run.

    Args:
        folder: the folder of the run.

    Raises:
        FileError: the journal is damaged.
        sqlite3.OperationalError: the disk is full …
    """

    def __init__(self, folder: Path, about: RecordSettings = RecordSettings()) -> None:
        self._folder = folder
        self._about = about
        self._journal = journal.open_to_write(folder)
        try:
            self._begin(about)
        except BaseException as error:  # only to close: every error is raised again
            self._journal.close()
            if isinstance(error, sqlite3.DatabaseError) and journal.is_damage(error):
                raise journal.damaged(folder / journal.JOURNAL_FILE, error) from error
            raise

    def _begin(self, about: RecordSettings) -> None:
        self._files = MeasuredFiles(self._folder, self._journal, about.facts, about.problems, about.speed)
        self._gathering = ScanAssembler(provenance.last_state(self._journal))
        self._is_corrected = provenance.is_corrected(self._journal)
        self._roles = ChannelRoles()
        for name, value in about.facts.items():
            self.note(name, value)
        if about.messages:
            self.note(journal.OWN_MESSAGES, about.messages)

    def waiting(self) -> list[Packet]:
        """Return the packets that wait for other packets of their scan."""
        return list(self._gathering.waiting())

    def take(self, packets: Iterable[tuple[Packet, str]]) -> None:
        """Record packets, each with its source, in the order of publication.

        Raises:
            OSError, sqlite3.OperationalError: the disk is full …; then no packet is recorded.
        """
        with self._all_or_nothing():
            for packet, source in packets:
                self._take(packet, source)

    def flush(self) -> None:
        """End the last scan if a channel of it has arrived. Raises as `take`."""
        if not self.waiting():
            return
        with self._all_or_nothing():
            self._write(self._gathering.flush())

    def finish(self) -> None:
        """End the open scan; a scan with lines only is recorded as interrupted. Raises as `take`."""
        with self._all_or_nothing():
            self._write(self._gathering.finish())

    def unlisted_files(self) -> list[str]:
        """Return the files of measurements that no table of the journal names, as paths in the run's folder."""
        return self._files.unlisted()

    def has(self, packet: Packet) -> bool:
        """Return whether a packet is recorded, or waits for other packets of its scan."""
        row = self._journal.execute(
            "SELECT 1 FROM packets WHERE time_ns = ? AND envelope = ?", (packet.time_ns, packet.envelope)
        )
        waits = ((one.time_ns, one.envelope) == (packet.time_ns, packet.envelope) for one in self._gathering.waiting())
        return row.fetchone() is not None or any(waits)

    def note(self, name: str, value: object) -> None:
        """Record a fact about the whole run, in JSON's types."""
        text = json.dumps(value, ensure_ascii=False)
        self._journal.execute("INSERT OR REPLACE INTO about VALUES (?, ?)", (name, text))

    def sync(self) -> None:
        """Sync the record to the disk, for the case of a power cut. Raises OSError."""
        with suppress(FileNotFoundError), (self._folder / f"{journal.JOURNAL_FILE}-wal").open("rb+") as file:
            sync_file(file.fileno())
        # a new file survives a power cut only if its folder is synced, too
        sync_folder(self._folder)

    def settle(self) -> None:
        """Merge the write-ahead log into the journal file, unless a reader has the journal open."""
        # shorter than the 30 s of other calls: an open reader may stay for hours
        self._journal.execute("PRAGMA busy_timeout = 1000")
        with suppress(sqlite3.OperationalError):  # a reader is open: the write-ahead log stays, which is as safe
            self._journal.execute("PRAGMA journal_mode = DELETE")

    def close(self) -> None:
        """Close files and journal. Safe to repeat."""
        self._files.close()
        self._journal.close()

    @contextmanager
    def _all_or_nothing(self) -> Iterator[None]:
        gathering = self._gathering.copy()
        self._journal.execute("BEGIN IMMEDIATE")
        try:
            yield
            # files first: the journal never names a file that a power cut could remove
            self._files.finish()
            self._journal.execute("COMMIT")
        except BaseException:  # only to roll back: every error is raised again, also KeyboardInterrupt
            self._files.discard()
            self._gathering = gathering
            with suppress(sqlite3.Error):  # after an error of a full disk, SQLite may have rolled back already
                self._journal.execute("ROLLBACK")
            raise

    def _take(self, packet: Packet, source: str) -> None:
        message, thing = _read(packet)
        if isinstance(thing, ChannelRoles) and source == SCHEDULER:
            self._roles = thing
        # packets come again after a restart, from the log and from the scheduler's cache
        if self.has(packet):
            return
        if message == "DriftMapping" and source == SCHEDULER:
            # published right before its scan; correction may begin during a run
            self._is_corrected = provenance.corrects(thing)
        match thing:
            case Scan() if thing.values.size and self._about.measured:
                self._write(self._gathering.scan(packet, self._placed(thing)))
            case ScanLines() if self._about.measured:
                self._write(self._gathering.lines(packet, self._placed(thing)))
            case Spectrum() if self._about.measured:
                self._write(self._gathering.spectrum(packet, replace(self._roles.shown(thing), frame=self._frame)))
            case _:
                self._add(packet, message, source, thing)

    def _add(self, packet: Packet, message: str, source: str, thing: object) -> None:
        payload = without_values(message, packet.payload) if message else bytes(packet.payload)
        insert_packet(self._journal, packet, message, payload, source=source)
        match thing:
            case ScopeStatus() if source == SCHEDULER:
                self._write(self._gathering.status(thing, packet.time_ns or 0))
            case JournalEntries():
                self._add_entries(thing)
            case ProcessStates():
                self._add_processes(thing)
            case LogLines():
                self._add_log(thing)
            case Note():
                note = JournalEntry(thing.time_ns, NOTE, thing.who, thing.text)
                self._add_entries(JournalEntries((note,)))

    def _write(self, taken: Iterable[Assembled]) -> None:
        for one in taken:
            # a measurement that fails leaves none of its rows in the transaction
            self._journal.execute("SAVEPOINT measured")
            try:
                self._files.write(one)
            except _ALL_OF_THEM:
                raise
            except Exception as error:  # any error of one measurement must not end the record
                self._journal.execute("ROLLBACK TO measured")
                self._keep(one)
                _log.error("no file can be made of what was measured, its packets are kept as they are: %s", error)
            self._journal.execute("RELEASE measured")

    def _keep(self, taken: Assembled) -> None:
        # whole packets with their values: no file contains this measurement
        for packet in taken.packets():
            insert_packet(self._journal, packet, wire.message_of(packet.envelope), bytes(packet.payload))

    @property
    def _frame(self) -> Frame:
        return self._about.frame if self._is_corrected else Frame.TIP

    def _placed(self, image: Image) -> Image:
        # the wire format does not carry frame and roles
        image, frame = self._roles.shown(image), self._frame
        return image if frame is Frame.TIP else replace(image, region=replace(image.region, frame=frame))

    def _add_entries(self, entries: JournalEntries) -> None:
        self._journal.executemany(
            "INSERT INTO entries VALUES (?, ?, ?, ?, ?, ?, ?)",
            [(e.time_ns, e.kind, e.who, e.what, e.response, e.reason, e.took_s) for e in entries.entries],
        )
        self._journal.executemany(
            "INSERT INTO starts VALUES (?, ?, ?)",
            [(e.sent_ns, e.what, e.key) for e in entries.entries if _is_start(e)],
        )

    def _add_processes(self, states: ProcessStates) -> None:
        for state in states.processes:
            row = (state.role, int(state.condition), state.since_ns, state.starts, state.pid, state.last_exit)
            if self._journal.execute(_PROCESS, (state.name,)).fetchone() != row:
                self._journal.execute(
                    "INSERT INTO processes VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (states.time_ns, state.name, *row)
                )

    def _add_log(self, log: LogLines) -> None:
        self._journal.executemany(
            "INSERT INTO log VALUES (?, ?, ?, ?)",
            [(line.time_ns, line.name, line.level, line.text) for line in log.lines],
        )


def _is_start(entry: JournalEntry) -> bool:
    # without a response the measurement may have started
    may_have_begun = entry.response in (ControlResponse.SUCCESS, ControlResponse.NO_RESPONSE)
    return entry.sent_ns is not None and entry.what in (names.START_SCAN, names.START_SPEC) and may_have_begun


def _read(packet: Packet) -> tuple[str, object]:
    try:
        message = wire.message_of(packet.envelope)
    except WireError:
        return "", None
    try:
        return message, wire.decode(message, packet.payload)
    except WireError:
        return "", None
