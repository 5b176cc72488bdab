"""The write-ahead log: state and packets are on disk before the scheduler publishes them.

The small state file has a JSON line for each saved state; the last line counts.
"""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from afspm.basics.errors import InvalidValue
from afspm.model import LoggedPacket
from afspm.model.snapshot import restored, snapshot
from afspm.scheduler.saved_state import KIND, VERSION, SavedState
from afspm.storage.atomic import CheckpointFile, OutageLog, load_checkpoint, previous_generation
from afspm.storage.disk import DEADLINE_S, SYNCER, DiskBacklogFull, DiskThread
from afspm.storage.packet_log import PacketLog


class StateFile:
    """The file of the scheduler's state (mode, holder, problems …), saved before a change is published.

    Args:
        path: the path of the file; None: nothing is stored.
    """

    def __init__(self, path: Path | None, log: logging.Logger) -> None:
        self.path = path
        self._generations = None if path is None else CheckpointFile(path)
        self._log = log
        self._outage = OutageLog("a restart would not know the present state", log)
        self._missed: SavedState | None = None

    def load(self) -> SavedState | None:
        """Return the state saved last; None if there is no file.

        If a power cut has damaged the last state, the last readable state before is used, with its mode and problems,
        but without a holder: the holder may have changed since, and requests control again. Only a holder that has
        switched the feedback off is kept, so that the scheduler retracts the tip after its death.

        Raises:
            FileError: no saved state can be read, or the folder is missing. Starting without a flagged problem could
                cost a tip.
        """
        if self.path is None:
            return None
        state, damage = load_checkpoint(self.path, _read)
        if state is None and previous_generation(self.path).exists():
            self._log.critical("the saved state is missing: control is free, and no problem is flagged (%s)", self.path)
        if state is None or not damage:
            return state
        is_kept = state.control.holder is not None and state.tip_risk.has_no_feedback
        holder = f"{state.control.holder} in control, as the feedback is off" if is_kept else "no component in control"
        self._log.critical("the newest saved state is damaged, the one before it is used, with %s: %s", holder, damage)
        return state if is_kept else state.without_holder()

    def save(self, state: SavedState) -> None:
        """Write the state, so that it outlives a kill.

        A full disk must not end the experiment: the outage is logged, and the experiment goes on.
        """
        if self._generations is None:
            return
        self._missed = state
        with self._outage.trying():
            self._generations.save(json.dumps(snapshot(state, KIND, VERSION), ensure_ascii=False).encode())
            self._missed = None

    def save_missed(self) -> None:
        """Write the state that a full disk did not take, if there is one."""
        if self._missed is not None:
            self.save(self._missed)

    def close(self) -> None:
        """Flush the last state to the disk."""
        if self._generations is not None:
            self._generations.close()


def _read(content: bytes) -> SavedState:
    try:
        return restored(SavedState, json.loads(content), KIND, VERSION)
    except (InvalidValue, AttributeError) as error:
        raise ValueError(str(error)) from error


_CLOSED_WITHIN_S = 5.0  # real; a hanging disk must not keep the process from ending


class WriteAhead:
    """The writer of state and packets, with a bounded wait: a slow disk must not delay control.

    A full or hanging disk is logged, and the experiment goes on. Entries that could not be written are written later,
    as far as they are still cached.

    Args:
        log: the packet log; None: no packets are stored.
        cached: returns the packets in the scheduler's cache.
        disk: the thread that writes; None: one of its own.
    """

    def __init__(
        self,
        state: StateFile,
        log: PacketLog | None,
        cached: Callable[[], Iterable[LoggedPacket]],
        logger: logging.Logger,
        disk: DiskThread | None = None,
    ) -> None:
        self._state = state
        self._log = log
        self._cached = cached
        self._disk = disk or DiskThread()
        self._outage = OutageLog("packets published now would be lost in a crash", logger)
        self._given_up = OutageLog("packets are given up that are not recorded yet", logger)
        self._missed_ns: int | None = None
        self._problems: frozenset[int] = frozenset()

    def write(self, state: SavedState | None, entries: Sequence[LoggedPacket]) -> None:
        """Save the state and append the packets; a newly flagged problem is also synced to the disk."""
        if state is None and not entries:
            return
        entries = [*self._missed(entries), *entries]

        def work() -> None:
            if state is not None:
                self._state.save(state)
            else:
                self._state.save_missed()
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
        """Flush and close the files; give up if that takes too long."""
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
