"""The write-ahead log: state and packets are on disk before the scheduler publishes them."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Sequence

from afspm.model import LoggedPacket
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.state_file import StateFile
from afspm.storage.atomic import OutageLog
from afspm.storage.disk import DEADLINE_S, SYNCER, DiskBacklogFull, DiskThread
from afspm.storage.packet_log import PacketLog

_CLOSED_WITHIN_S = 5.0  # real; a hanging disk must not keep the process from ending


class WriteAhead:
    """A thread that writes, with a short wait for the disk: a slow disk must not delay control.

    A full or hanging disk is logged, and the experiment goes on. Entries that could not be written are written later,
    as far as they are still cached.

    Args:
        log: None: no packets are stored.
        cached: returns the packets in the scheduler's cache.
    """

    def __init__(
        self,
        state: StateFile,
        log: PacketLog | None,
        cached: Callable[[], Iterable[LoggedPacket]],
        logger: logging.Logger,
    ) -> None:
        self._state = state
        self._log = log
        self._cached = cached
        self._disk = DiskThread()
        self._outage = OutageLog("packets published now would be lost in a crash", logger)
        self._given_up = OutageLog("packets are given up that are not recorded yet", logger)
        self._missed_ns: int | None = None
        self._problems: frozenset[int] = frozenset()

    def write(self, state: SavedState | None, entries: Sequence[LoggedPacket]) -> None:
        """Save the state and append the packets; new problems are flushed to the disk."""
        if state is None and not entries:
            return
        entries = [*self._missed(entries), *entries]

        def work() -> None:
            if state is not None:
                self._state.save(state)
            self._append(entries)

        with self._outage.trying():
            try:
                self._disk.run(work, sum(len(entry.packet.payload) for entry in entries))
            except DiskBacklogFull:
                self._note_missed(entries)
                raise
            # a power cut must not lose a flagged problem: resumed without it, the run could cost a tip
            if state is not None and self._has_new_problems(state):
                SYNCER.now(DEADLINE_S)
            self._clean()

    def close(self) -> None:
        """Flush and close the files, if that does not take too long."""
        with contextlib.suppress(OSError):
            if self._log is not None:
                self._disk.run(self._log.close)
            self._disk.run(self._state.close)
        self._disk.close(_CLOSED_WITHIN_S)

    def _append(self, entries: Sequence[LoggedPacket]) -> None:
        # runs in the disk's thread
        if self._log is None:
            return
        for number, entry in enumerate(entries):
            try:
                self._log.append(entry)
            except OSError:
                self._note_missed(entries[number:])
                raise

    def _note_missed(self, entries: Sequence[LoggedPacket]) -> None:
        times = [entry.packet.time_ns or 0 for entry in entries]
        self._missed_ns = min(times if self._missed_ns is None else [self._missed_ns, *times], default=None)

    def _missed(self, entries: Sequence[LoggedPacket]) -> list[LoggedPacket]:
        missed_ns, self._missed_ns = self._missed_ns, None
        if missed_ns is None:
            return []
        new = {entry.packet.time_ns for entry in entries}
        # the cache bounds how much a hanging disk may hold back
        since = [entry for entry in self._cached() if (entry.packet.time_ns or 0) >= missed_ns]
        return [entry for entry in since if entry.packet.time_ns not in new]

    def _clean(self) -> None:
        log = self._log
        if log is None or not log.has_grown:
            return
        cached = list(self._cached())

        def work() -> None:
            with self._given_up.trying():
                if not log.clean(cached):
                    raise OSError("the recorder does not keep up")

        self._disk.submit(work)

    def _has_new_problems(self, state: SavedState) -> bool:
        before, self._problems = self._problems, frozenset(state.control.problems)
        return not self._problems <= before
