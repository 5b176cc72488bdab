"""What the recorder does beside listening: one thread that writes, so that a slow disk holds up nobody."""

from __future__ import annotations

import heapq
import logging
import sqlite3
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, suppress
from itertools import chain, groupby
from pathlib import Path
from typing import NamedTuple

from afspm.clock import Clock
from afspm.errors import FileError
from afspm.model import Packet
from afspm.record import ahead
from afspm.record.journal import JOURNAL_FILE, SCHEDULER, damaged, is_damage
from afspm.record.store import RecordSettings, RecordStore

MOST_BYTES = 256 << 20
"""So much waits to be written at most; beyond it all is dropped, and taken from what others keep once there is room."""
MUCH_BYTES = 64 << 20
AT_ONCE, AT_ONCE_BYTES = 500, 32 << 20
LINGER_S = 0.05
"""What has come waits so long for more, so that nothing is recorded while it is still on its way to others."""
AGAIN_S = 2.0
QUIET_S = 1.0
SURE_S = 5.0
"""What is recorded is said so much later: if a connection was lost, what came in between is looked for first."""
CAUGHT_UP_WITHIN_S = 2.0
LAST_WORDS_S = 30.0
STOPPING_S = 1.0

DISK_ERRORS = (OSError, sqlite3.OperationalError)


class _Item(NamedTuple):
    """A packet with its source; without one: all that the scheduler had kept has come."""

    packet: Packet | None
    source: str = SCHEDULER


class RecordWriter:
    """Takes packets from one thread, and records them in another.

    Args:
        folder: of the run.
        state: its state folder, with what was written ahead; None: there is none.
        step: entered around everything that takes time.
        wake: called when `check` or `wants_replay` has something to say.
    """

    def __init__(
        self,
        folder: Path,
        state: Path | None,
        about: RecordSettings,
        clock: Clock,
        log: logging.Logger,
        *,
        step: Callable[[], AbstractContextManager[None]],
        wake: Callable[[], None],
    ) -> None:
        self._folder = folder
        self._state = state
        self._about = about
        self._clock = clock
        self._log = log
        self._step = step
        self._wake = wake
        self._changed = threading.Condition()
        self._queue: deque[_Item] = deque()
        self._bytes = 0
        self._missed = False
        self._wants_replay = False
        self._ending: bool | None = None
        self._until_s = 0.0
        self._error: BaseException | None = None
        self._told_full = self._told_much = False
        self._recorded: deque[tuple[float, int]] = deque()
        self._said_ns = -1
        self._held: list[_Item] | None = []  # until all that was kept has come, or nothing is going to say so
        self._began_s = clock.monotonic_s()
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)

    # --- called by the one who listens ---

    def start(self) -> None:
        self._thread.start()

    def put(self, packet: Packet, source: str) -> None:
        """To be recorded."""
        if packet.time_ns is None:  # of a publisher of version 1
            packet = Packet(packet.envelope, packet.payload, self._clock.now_ns())
        with self._changed:
            self._queue.append(_Item(packet, source))
            self._bytes += len(packet.payload)
            if self._bytes > MOST_BYTES and self._told_full:
                self._queue.clear()
                self._bytes, self._missed = 0, True
            self._changed.notify()
        if self._bytes > MUCH_BYTES and not self._told_much:
            self._told_much = True
            self._log.warning("the disk does not keep up: %.0f MB wait to be recorded", self._bytes / 2**20)

    def caught_up(self) -> None:
        """All that the scheduler had kept for us has come."""
        with self._changed:
            self._queue.append(_Item(None))
            self._changed.notify()

    def wants_replay(self) -> bool:
        """Whether something was missed and there is room now: then all that is kept should be asked for again."""
        with self._changed:
            wanted, self._wants_replay = self._wants_replay, False
        return wanted

    def check(self) -> None:
        """Raises what has ended the writing, if anything."""
        if self._error is not None:
            raise self._error

    def finish(self, *, ended: bool) -> None:
        """Record what is left; returns when that is done, or takes too long.

        Args:
            ended: the experiment has ended; else it may go on another time.
        """
        within_s = LAST_WORDS_S if ended else STOPPING_S
        with self._changed:
            self._ending, self._until_s = ended, self._clock.monotonic_s() + within_s
            self._changed.notify()
        self._thread.join(within_s + AGAIN_S)
        self.check()

    # --- the thread ---

    def _run(self) -> None:
        try:
            while (store := self._opened()) is not None and (damage := self._record_all(store)) is not None:
                self._put_aside(damage)
                # what was taken and is not recorded is written ahead, or kept by the scheduler
                self._held, self._began_s = [], self._clock.monotonic_s()
                with self._changed:
                    self._wants_replay = True
                self._wake()
        except BaseException as error:
            self._error = error
            self._wake()

    def _record_all(self, store: RecordStore) -> FileError | None:
        """Record until it is over, or the journal turns out to be damaged: then it is said how."""
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
                    return RecordStore(self._folder, self._about)
            except DISK_ERRORS as error:
                if not self._put_off(error):
                    return None
            except FileError as error:
                self._put_aside(error)

    def _put_aside(self, error: FileError) -> None:
        """A journal that can't be read is no reason to record nothing."""
        number = len(list(self._folder.glob(f"{JOURNAL_FILE}.damaged-*"))) + 1
        for suffix in ("", "-wal", "-shm"):
            file = self._folder / f"{JOURNAL_FILE}{suffix}"
            if file.exists():
                file.replace(self._folder / f"{JOURNAL_FILE}.damaged-{number}{suffix}")
        self._log.critical("%s; it is put aside, and a new one is begun", error)

    def _go_on(self, store: RecordStore) -> bool:
        """Record what has come; False: it is over."""
        batch, ending = self._next()
        if batch:
            self._record(store, batch)
        elif self._held is not None and self._clock.monotonic_s() > self._began_s + CAUGHT_UP_WITHIN_S:
            self._record(store, [_Item(None)])  # of version 1: it does not say
        elif ending is None:
            self._safely(store.flush)
        self._say(store, now=False)
        if ending is None or batch:
            return True
        self._end(store, ended=ending)
        return False

    def _next(self) -> tuple[list[_Item], bool | None]:
        """The next packets; none if nothing has come for a while, or it is ending."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._ending is not None, QUIET_S)
            if self._queue and self._state is not None:  # where it is written ahead, and so nothing is lost meanwhile
                self._changed.wait_for(lambda: self._bytes > AT_ONCE_BYTES or self._ending is not None, LINGER_S)
            batch: list[_Item] = []
            size = 0
            while self._queue and len(batch) < AT_ONCE and size < AT_ONCE_BYTES:
                item = self._queue.popleft()
                batch.append(item)
                size += len(item.packet.payload) if item.packet else 0
            self._bytes -= size
            if not self._queue and self._told_much:
                self._told_much = False
                self._log.info("everything is recorded again")
            return batch, self._ending

    def _record(self, store: RecordStore, batch: list[_Item]) -> None:
        for is_packet, items in groupby(batch, lambda item: item.packet is not None):
            if not is_packet:
                held, self._held = self._held or [], None
                self._take_missed(store, held)
            elif self._held is not None:
                self._held += items
            else:
                self._take(store, list(items))

    def _take_missed(self, store: RecordStore, held: Iterable[_Item]) -> None:
        """What was published while nobody listened: written ahead by the scheduler, or kept by it."""
        found = heapq.merge(self._written_ahead(), sorted(held, key=_time), key=_time)
        for items in _some_at_a_time(found):
            self._take(store, items)

    def _written_ahead(self) -> Iterator[_Item]:
        if self._state is None:
            return iter(())
        # not what is newer than all that is recorded: lines of a scan wait for the rest of it
        since_ns = ahead.recorded_until(self._state / ahead.RECORDED_FILE)
        found = (ahead.written_ahead(folder, since_ns) for folder in ahead.folders(self._state))
        return (_Item(written.packet) for written in chain.from_iterable(found))

    def _take(self, store: RecordStore, items: list[_Item]) -> None:
        self._safely(lambda: store.take((item.packet, item.source) for item in items if item.packet))

    def _safely(self, do: Callable[[], None]) -> None:
        """Do it as soon as there is room on the disk."""
        while True:
            try:
                with self._step():
                    do()
            except DISK_ERRORS as error:
                if not self._put_off(error):
                    return
                continue
            if self._told_full:
                self._told_full = False
                self._log.info("there is room on the disk again")
            with self._changed:
                missed, self._missed = self._missed, False
                self._wants_replay = self._wants_replay or missed
            if missed:
                self._held, self._began_s = [], self._clock.monotonic_s()
                self._wake()
            return

    def _put_off(self, error: Exception) -> bool:
        """The disk is full, or gone: said once, and tried again in a while. False: it is ending, and too late."""
        if not self._told_full:
            self._told_full = True
            self._log.critical("nothing can be recorded, the experiment goes on: %s", error)
        with self._changed:
            self._changed.wait_for(lambda: False, AGAIN_S if self._ending is None else AGAIN_S / 10)
            return self._ending is None or self._clock.monotonic_s() < self._until_s

    def _end(self, store: RecordStore, *, ended: bool) -> None:
        self._record(store, [_Item(None)])
        self._safely(store.finish if ended else store.flush)
        if ended:
            self._safely(lambda: store.note("ended_ns", self._clock.now_ns()))
        self._say(store, now=True)
        if ended:
            store.settle()

    def _say(self, store: RecordStore, *, now: bool) -> None:
        """Say up to when everything is recorded, to those who keep it until then."""
        if self._state is None or self._held is not None or self._missed:
            return
        sure_ns = store.recorded_ns if now else self._sure_ns(store.recorded_ns)
        if sure_ns is None or sure_ns <= self._said_ns:
            return
        try:
            with self._step():
                store.sync()
                ahead.say_recorded(self._state / ahead.RECORDED_FILE, sure_ns)
            self._said_ns = sure_ns
        except OSError as error:
            self._log.debug("what is recorded can't be said: %s", error)

    def _sure_ns(self, recorded_ns: int) -> int | None:
        """Up to when everything was recorded some time ago, if that is more than was said already."""
        now_s, sure_ns = self._clock.monotonic_s(), None
        if not self._recorded or now_s >= self._recorded[-1][0] + QUIET_S:
            self._recorded.append((now_s, recorded_ns))
        while self._recorded and self._recorded[0][0] <= now_s - SURE_S:
            sure_ns = self._recorded.popleft()[1]
        return sure_ns


def _time(item: _Item) -> int:
    return item.packet.time_ns or 0 if item.packet else 0


def _some_at_a_time(items: Iterable[_Item]) -> Iterator[list[_Item]]:
    some: list[_Item] = []
    size = 0
    for item in items:
        some.append(item)
        size += len(item.packet.payload) if item.packet else 0
        if len(some) >= AT_ONCE or size >= AT_ONCE_BYTES:
            yield some
            some, size = [], 0
    if some:
        yield some
