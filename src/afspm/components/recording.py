"""The recorder's thread, which follows the packet log and writes the record: a slow disk delays no other process."""

from __future__ import annotations

import logging
import sqlite3
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from afspm.basics.clock import Clock
from afspm.basics.errors import FileError
from afspm.model import Packet
from afspm.model.events import NO_LONGER_TRUE
from afspm.record.journal import JOURNAL_FILE, SCHEDULER, damaged, is_damage
from afspm.record.store import RecordSettings, RecordStore
from afspm.storage.packet_log import SEGMENT_BYTES, START, LogReader, Position, commit, committed

# backlog above which a warning is logged: the log is finite, and its oldest packets are overwritten
FAR_BEHIND_BYTES = 64 << 20
# limit the memory for one batch, and the length of one step: 10,000 log lines take 0.3 s of a processor
AT_ONCE_BYTES = 32 << 20
LAST_WORDS_S = 30.0

_MOST_NAMED = 3
_UNRECORDED = "nothing can be recorded"

DISK_ERRORS = (OSError, sqlite3.OperationalError)


@dataclass(frozen=True)
class WriterLimits:
    """Times, in s of real time, and sizes that limit the work of a `RecordWriter`."""

    look_s: float = 0.1
    """Interval of reads of the log: delivery to other processes comes before recording."""
    longest_look_s: float = 0.25
    """The interval of reads that find nothing: it doubles up to here, so that an idle run costs little."""
    again_s: float = 2.0  # between attempts while the disk has no room
    # after a silence incomplete scans are written, too: their last channel may never come
    quiet_s: float = 1.0
    # each commit syncs the disk, so not after every packet
    commit_s: float = 1.0
    # a run that stops may be resumed, and then the log is read on from the last commit: no need to wait long
    stopping_s: float = 1.0
    most_at_once: int = 10_000  # packets in one read of the log
    most_bytes: int = 256 << 20
    """Limit on waiting packets of other publishers; beyond it all are dropped, and requested again later."""


class SourcedPacket(NamedTuple):
    """A packet with its publisher's address; `before` is its position in the log, None if not from the log."""

    packet: Packet
    source: str = SCHEDULER
    before: Position | None = None


class RecordWriter:
    """A thread that records packets of the log, and packets given by `put`.

    Args:
        folder: the folder of the run.
        log: folder of the packet log; without a log, all packets are given by `put`.
        step: context manager entered around every slow operation.
        wake: called when the result of `check` or `wants_replay` may have changed.
        limits: None: the usual ones.
        open_store: opens the record of a folder.
    """

    def __init__(
        self,
        folder: Path,
        log: Path,
        settings: RecordSettings,
        clock: Clock,
        logger: logging.Logger,
        *,
        step: Callable[[], AbstractContextManager[None]],
        wake: Callable[[], None],
        limits: WriterLimits | None = None,
        open_store: Callable[[Path, RecordSettings], RecordStore] = RecordStore,
    ) -> None:
        self._limits, self._open_store = limits or WriterLimits(), open_store
        self._folder = folder
        self._settings = settings
        self._clock = clock
        self._logger = logger
        self._step = step
        self._wake = wake
        self._progress = LogProgress(log, self._limits)
        self._inbox = RecordInbox(self._limits)
        self._error: BaseException | None = None
        self._told_full = self._told_behind = self._told_removed = self._has_found = False
        self._look_s = self._limits.look_s
        self._heard_s = self._committed_s = clock.monotonic_s()
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)

    # --- called from the listener's thread ---

    def start(self) -> None:
        self._thread.start()

    def put(self, packet: Packet, source: str) -> None:
        """Queue a packet that is not in the log."""
        if packet.time_ns is None:  # of a publisher of another make
            packet = Packet(packet.envelope, packet.payload, self._clock.now_ns())
        self._inbox.put(SourcedPacket(packet, source), is_disk_full=self._told_full)

    def wants_replay(self) -> bool:
        """Return whether to request publishers' cached packets, and reset the answer to False.

        True after a full disk has caused packets to be dropped, once it has room again; and after a damaged journal.
        """
        return self._inbox.wants_replay()

    def check(self) -> None:
        """Raise the error that ended the writing, if any."""
        if self._error is not None:
            raise self._error

    def finish(self, *, ended: bool) -> None:
        """Record the remaining packets; return once they are recorded, or after a time limit.

        Args:
            ended: whether the experiment has ended; otherwise it may be resumed.
        """
        within_s = LAST_WORDS_S if ended else self._limits.stopping_s
        self._inbox.end(self._clock.monotonic_s() + within_s, ended=ended)
        self._thread.join(within_s + self._limits.again_s)
        self.check()

    # --- in the writer's thread ---

    def _run(self) -> None:
        try:
            while (store := self._opened()) is not None and (damage := self._record_all(store)) is not None:
                self._put_aside(damage)
        except BaseException as error:  # of any kind: `check` raises it in the thread that can end the process
            self._error = error
            self._wake()

    def _record_all(self, store: RecordStore) -> FileError | None:
        try:
            while self._go_on(store):
                pass
        except sqlite3.DatabaseError as error:
            if not is_damage(error):
                raise
            return damaged(self._folder / JOURNAL_FILE, error)
        finally:
            with suppress(sqlite3.DatabaseError):
                store.close()
        return None

    def _opened(self) -> RecordStore | None:
        while True:
            try:
                with self._step():
                    return self._open_store(self._folder, self._settings)
            except DISK_ERRORS as error:
                if not self._put_off(error):
                    return None
            except FileError as error:
                self._put_aside(error)

    def _put_aside(self, error: FileError) -> None:
        # a damaged journal must not keep the rest of the night from being recorded
        number = len(list(self._folder.glob(f"{JOURNAL_FILE}.damaged-*"))) + 1
        for suffix in ("", "-wal", "-shm"):
            file = self._folder / f"{JOURNAL_FILE}{suffix}"
            if file.exists():
                file.replace(self._folder / f"{JOURNAL_FILE}.damaged-{number}{suffix}")
        self._logger.critical("%s; moved it aside, and began a new one", error)
        self._progress.begin_again()
        self._inbox.want_replay()
        self._wake()

    def _go_on(self, store: RecordStore) -> bool:
        batch, ending = self._next()
        now_s = self._clock.monotonic_s()
        if batch:
            self._heard_s = now_s
            if not self._safely(lambda: store.take((one.packet, one.source) for one in batch)):
                self._progress.stop()
        elif ending is None and now_s > self._heard_s + self._limits.quiet_s:
            self._safely(store.flush)
        with self._step():
            self._progress.took(batch, store.waiting())
        if now_s > self._committed_s + self._limits.commit_s:
            self._commit(store)
        if ending is None or batch:
            return True
        self._end(store, ended=ending)
        return False

    def _next(self) -> tuple[list[SourcedPacket], bool | None]:
        is_behind = self._told_behind or self._progress.has_more
        queued, ending = self._inbox.take(within_s=0.0 if is_behind else self._look_s)
        logged: list[SourcedPacket] = []
        try:
            # a heartbeat between two batches must not show an idle recorder: at the end of a run the supervisor would
            # ask it to end, and leave it 1.5 s of a processor for all that waits
            with self._step() if self._has_found else nullcontext():
                logged = self._progress.read()
        except OSError as error:
            self._put_off(error)
        self._tell_behind()
        found = [*logged, *queued]
        self._has_found = bool(found)
        limits = self._limits
        self._look_s = limits.look_s if found else min(2.0 * self._look_s, limits.longest_look_s)
        return found, ending

    def _tell_behind(self) -> None:
        behind = self._progress.behind_bytes()
        if behind > FAR_BEHIND_BYTES and not self._told_behind:
            self._logger.warning("the disk does not keep up: %.0f MB wait to be recorded", behind / 2**20)
        elif self._told_behind and not behind:
            self._logger.info("everything is recorded again")
        self._told_behind = behind > (0 if self._told_behind else FAR_BEHIND_BYTES)

    def _safely(self, do: Callable[[], None]) -> bool:
        while True:
            try:
                with self._step():
                    do()
            except DISK_ERRORS as error:
                if not self._put_off(error):
                    return False
                continue
            if self._told_full:
                self._told_full = False
                self._logger.info("there is room on the disk again; %s%s", NO_LONGER_TRUE, _UNRECORDED)
            if self._inbox.has_room_for_missed():
                self._wake()
            return True

    def _tell_removed(self) -> None:
        # the system keeps an open file that was removed, so no write fails until the process ends
        journal = self._folder / JOURNAL_FILE
        if not self._told_removed and not journal.exists():
            self._told_removed = True
            text = "%s was removed while the run goes on: its record is lost; end the run, and start a new one"
            self._logger.critical(text, journal)

    def _put_off(self, error: Exception) -> bool:
        # the disk is full or gone: logged once, then tried again until it has room, or the run ends
        if not self._told_full:
            self._told_full = True
            self._logger.critical("%s, the experiment goes on: %s", _UNRECORDED, error)
        until_s = self._inbox.pause()
        return until_s is None or self._clock.monotonic_s() < until_s

    def _end(self, store: RecordStore, *, ended: bool) -> None:
        if not self._safely(store.finish if ended else store.flush):
            self._progress.stop()
        if ended:
            self._safely(lambda: store.note("ended_ns", self._clock.now_ns()))
        self._progress.took([], store.waiting())
        self._commit(store)
        if ended:
            self._warn_unlisted(store)
            store.settle()

    def _warn_unlisted(self, store: RecordStore) -> None:
        if unlisted := store.unlisted_files():
            self._logger.warning(
                "%d measured files are in no table of the record, since a power cut took their packets, or a damaged "
                "journal was put aside; they can be read: %s%s",
                len(unlisted),
                ", ".join(unlisted[:_MOST_NAMED]),
                " …" if len(unlisted) > _MOST_NAMED else "",
            )

    def _commit(self, store: RecordStore) -> None:
        # the log may be overwritten up to here
        self._committed_s = self._clock.monotonic_s()
        self._tell_removed()
        try:
            with self._step():
                self._progress.commit(store.sync)
        except OSError as error:
            self._logger.debug("the progress of the record can't be saved: %s", error)


class RecordInbox:
    """Packets that wait to be recorded, and the request to end: the state shared by listener and writer."""

    def __init__(self, limits: WriterLimits) -> None:
        self._limits = limits
        self._changed = threading.Condition()
        self._queue: list[SourcedPacket] = []
        self._bytes = 0
        self._missed = False
        self._wants_replay = False
        self._ending: bool | None = None
        self._until_s = 0.0

    def put(self, packet: SourcedPacket, *, is_disk_full: bool) -> None:
        """Queue a packet. If more than `most_bytes` wait on a full disk, all are dropped, and requested again later."""
        with self._changed:
            self._queue.append(packet)
            self._bytes += len(packet.packet.payload)
            if self._bytes > self._limits.most_bytes and is_disk_full:
                self._queue.clear()
                self._bytes, self._missed = 0, True
            self._changed.notify()

    def take(self, *, within_s: float) -> tuple[list[SourcedPacket], bool | None]:
        """Return the queued packets, and the argument `ended` of `end`; None before `end` was called.

        Wait up to `within_s` for more than AT_ONCE_BYTES, or for the end of the recording.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._bytes > AT_ONCE_BYTES or self._ending is not None, within_s)
            queued, self._queue, self._bytes = self._queue, [], 0
            return queued, self._ending

    def end(self, until_s: float, *, ended: bool) -> None:
        """Ask the writer to end by `until_s`; `ended`: whether the experiment has ended."""
        with self._changed:
            self._ending, self._until_s = ended, until_s
            self._changed.notify()

    def pause(self) -> float | None:
        """Wait a moment for room on the disk; return the time limit for such waits, None without a limit."""
        with self._changed:
            again_s = self._limits.again_s
            self._changed.wait_for(lambda: False, again_s if self._ending is None else again_s / 10)
            return None if self._ending is None else self._until_s

    def want_replay(self) -> None:
        with self._changed:
            self._wants_replay = True

    def has_room_for_missed(self) -> bool:
        """Request publishers' cached packets if packets were dropped; return whether packets were dropped."""
        with self._changed:
            missed, self._missed = self._missed, False
            self._wants_replay = self._wants_replay or missed
            return missed

    def wants_replay(self) -> bool:
        """Return whether to request publishers' cached packets, and reset the answer to False."""
        with self._changed:
            wanted, self._wants_replay = self._wants_replay, False
            return wanted


class LogProgress:
    """Progress of reading a packet log, and of recording it.

    Args:
        log: folder of the packet log; it may be missing.
    """

    def __init__(self, log: Path, limits: WriterLimits) -> None:
        self._log, self._limits = log, limits
        self._reader = LogReader(log, committed(log) or START)
        self._committed = self._reader.position
        self._stopped = False
        self._waiting: dict[tuple[int | None, str], Position] = {}

    def begin_again(self) -> None:
        self._reader = LogReader(self._log)
        self._waiting.clear()

    def stop(self) -> None:
        """Stop committing positions, since a packet that was read could not be recorded."""
        self._stopped = True

    def read(self) -> list[SourcedPacket]:
        """Return the next packets of the log, a limited number of bytes at a time."""
        before = self._reader.position
        found = []
        for entry, behind in self._reader.read(AT_ONCE_BYTES, self._limits.most_at_once):
            found.append(SourcedPacket(entry.packet, SCHEDULER, before))
            before = behind
        return found

    @property
    def has_more(self) -> bool:
        """Whether the last batch was cut: more packets may be there."""
        return self._reader.is_cut

    def behind_bytes(self) -> int:
        """Return the nominal size in bytes of the unread segments, without the present and the newest segment."""
        return max(0, self._reader.newest - self._reader.position.segment - 1) * SEGMENT_BYTES

    def took(self, batch: list[SourcedPacket], waiting: list[Packet]) -> None:
        """Register the packets of a batch that are still in `waiting`: `commit` stays before them."""
        for packet, _, before in batch:
            if before is not None:
                self._waiting.setdefault((packet.time_ns, packet.envelope), before)
        still = {(packet.time_ns, packet.envelope) for packet in waiting}
        self._waiting = {key: before for key, before in self._waiting.items() if key in still}

    def commit(self, sync: Callable[[], None]) -> None:
        """Commit the position up to which all packets are recorded, after `sync` to the disk. Raises OSError."""
        position = min(self._waiting.values(), default=self._reader.position)
        if self._stopped or position <= self._committed or committed(self._log) is None:
            return
        sync()
        commit(self._log, position)
        self._committed = position
