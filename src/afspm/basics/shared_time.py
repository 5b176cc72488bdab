"""Simulated time that the processes of a run share in a small file, and that waits for processes that are behind.

Simulated time runs faster than the processes can compute, most of all on a busy computer. A process that needs
computing time but no experiment time declares a hold: while any hold is active, experiment time passes as fast as real
time. A hold is active at once (a registration), from a moment of experiment time on (a sleep: the process may wake up
late), or once results or lines are published (their receiver). A hold ends with its `with` block. If its
process dies, the supervisor drops the hold. After `LONGEST_HOLD_S` the time goes on without it, and the supervisor logs
and counts that.

The file holds the origin (real and experiment time of the last change), two numbers derived from the holds, which are
enough to tell the time, and the holds. Each change moves the origin to its own moment, so that the time is continuous.
Reads of the time wait until a change is complete: one made while the writer waited for a processor could be seconds of
experiment time ahead of the slow time that the change begins.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import threading
import time
import weakref
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

from afspm.basics.file_lock import locked, unless_locked

_NS_PER_S = 1_000_000_000
LONGEST_HOLD_S = 600.0
"""Real time after which a hold no longer counts: a process that hangs must not slow the night for ever. Registering the
largest scans takes a minute on a computer with a load of forty."""
MOST_HOLDS = 64  # a process has one to three at a time; further ones are not kept, which the supervisor logs
_LOOKS = 1000  # reads while a change is being made; then its maker was stopped or killed: the last valid content counts
_LOOKS_AT_ONCE = 20  # a change takes some 20 µs, unless its maker waits for a processor
_LOOK_S = 0.001
_NEVER_NS = 1 << 62  # experiment time of a hold that begins with a publication: this, and the number of its kind
_HEAD = struct.Struct("<5q")
_HOLD = struct.Struct("<4q")
_AT_ONCE_NS = -_NEVER_NS  # before every start of a clock, which may lie before 1970
_LATEST_S = 4e9
_CHECKSUM = struct.Struct("<I")
_SIZE = _HEAD.size + MOST_HOLDS * _HOLD.size
_CHANGING, _UNCHANGING = b"\1", b"\0"  # the last byte of the file


class Publication(Enum):
    """A kind of publication by the translator, from which on its receivers are late."""

    RESULTS = 0
    LINES = 1


@dataclass(frozen=True, slots=True)
class TimeHold:
    """A process for which simulated time waits.

    Attributes:
        begun_ns: real time of the declaration; with `pid` the identity of the hold.
        from_ns: experiment time from which time waits.
        until_ns: real time up to which time waits; 0 while the hold is not active yet.
        pid: the process.
    """

    begun_ns: int
    from_ns: int
    until_ns: int
    pid: int

    def is_same(self, other: TimeHold) -> bool:
        return (self.begun_ns, self.pid) == (other.begun_ns, other.pid)

    def waited_s(self, real_ns: int) -> float:
        """Return how long time has waited for the process, in s of real time."""
        since_ns = self.until_ns - int(LONGEST_HOLD_S * _NS_PER_S)
        return max(0, real_ns - since_ns) / _NS_PER_S if self.until_ns else 0.0


@dataclass(frozen=True, slots=True)
class SharedTime:
    """The content of the file. Times are in ns: `real` of `time.monotonic_ns`, `shown` of the experiment.

    Attributes:
        real_ns: moment of the last change.
        shown_ns: experiment time at that moment.
        slow_until_ns: real time up to which time is slow.
        next_from_ns: experiment time from which the next hold slows time down; 0 without one.
        refused: number of holds that found no room.
    """

    real_ns: int
    shown_ns: int
    slow_until_ns: int = 0
    next_from_ns: int = 0
    refused: int = 0
    holds: tuple[TimeHold, ...] = ()

    def at(self, real_ns: int, speed: float) -> int:
        """Return the experiment time at a moment of real time."""
        left_ns = max(0, real_ns - self.real_ns)
        slow_ns = min(left_ns, max(0, self.slow_until_ns - self.real_ns))
        shown_ns, left_ns = self.shown_ns + slow_ns, left_ns - slow_ns
        if self.next_from_ns:
            fast_ns = max(0, math.ceil((self.next_from_ns - shown_ns) / speed))
            if left_ns <= fast_ns:
                return min(shown_ns + int(left_ns * speed), max(shown_ns, self.next_from_ns))
            left_ns -= fast_ns
            slow_ns = min(left_ns, int(LONGEST_HOLD_S * _NS_PER_S))
            shown_ns, left_ns = max(shown_ns, self.next_from_ns) + slow_ns, left_ns - slow_ns
        return shown_ns + int(left_ns * speed)

    def with_hold(self, hold: TimeHold) -> SharedTime:
        """Return the content with one more hold; if there is no room, it is counted as refused."""
        if len(self.holds) == MOST_HOLDS:
            return replace(self, refused=self.refused + 1)
        return replace(self, holds=(*self.holds, hold))

    def without_hold(self, hold: TimeHold) -> SharedTime:
        return replace(self, holds=tuple(one for one in self.holds if not one.is_same(hold)))

    def with_published(self, what: Publication) -> SharedTime:
        """Return the content in which the holds that begin with a publication have begun."""
        begun = (
            replace(one, from_ns=_AT_ONCE_NS) if one.from_ns == _NEVER_NS + what.value else one for one in self.holds
        )
        return replace(self, holds=tuple(begun))

    def moved_to(self, real_ns: int, speed: float) -> SharedTime:
        """Return the content with its origin at a later moment."""
        return replace(self, real_ns=max(real_ns, self.real_ns), shown_ns=self.at(real_ns, speed))

    def settled(self) -> SharedTime:
        """Return the content with the limits of the holds that have begun, and the derived numbers."""
        until_ns = self.real_ns + int(LONGEST_HOLD_S * _NS_PER_S)
        holds = tuple(
            replace(one, until_ns=until_ns) if not one.until_ns and one.from_ns <= self.shown_ns else one
            for one in self.holds
        )
        coming = [one.from_ns for one in holds if not one.until_ns and one.from_ns < _NEVER_NS]
        slow_until_ns = max((one.until_ns for one in holds), default=0)
        return replace(self, holds=holds, slow_until_ns=slow_until_ns, next_from_ns=min(coming, default=0))

    def as_bytes(self) -> bytes:
        # the checksum shows a reader that a writer was killed half way
        head = _HEAD.pack(self.real_ns, self.shown_ns, self.slow_until_ns, self.next_from_ns, self.refused)
        holds = b"".join(_HOLD.pack(one.begun_ns, one.from_ns, one.until_ns, one.pid) for one in self.holds)
        packed = (head + holds).ljust(_SIZE, b"\0")
        return packed + _CHECKSUM.pack(zlib.crc32(packed))

    @classmethod
    def from_bytes(cls, packed: bytes) -> SharedTime | None:
        """Return the content; None if it was written in part only."""
        if _CHECKSUM.unpack_from(packed, _SIZE)[0] != zlib.crc32(packed[:_SIZE]):
            return None
        holds = (TimeHold(*_HOLD.unpack_from(packed, _HEAD.size + number * _HOLD.size)) for number in range(MOST_HOLDS))
        head: tuple[int, int, int, int, int] = _HEAD.unpack_from(packed)
        return cls(*head, holds=tuple(one for one in holds if one.pid))


@dataclass(eq=False)
class _OwnHold:
    """A hold of this process, of the thread that declared it; None while its thread lets time pass."""

    from_ns: int
    thread: int = field(default_factory=threading.get_ident)
    hold: TimeHold | None = None


class SharedSimulationTime:
    """Simulated time, shared by the processes of a run in a small file; it waits for processes that are behind.

    Args:
        path: an existing file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("r+b")  # stays open: opening it may hang with the disk, and a late process must not
        weakref.finalize(self, self._file.close)
        self._turn = threading.RLock()  # threads of one process share the lock of the file
        self._map = mmap.mmap(self._file.fileno(), _SIZE + _CHECKSUM.size + len(_CHANGING))
        self._last = b"", SharedTime(0, 0)  # the file's bytes, and their content
        self._own: list[_OwnHold] = []

    @staticmethod
    def create(path: Path, shown_ns: int) -> SharedSimulationTime:
        """Create the file, with an experiment time in ns."""
        path.write_bytes(SharedTime(time.monotonic_ns(), shown_ns).as_bytes() + _UNCHANGING)
        return SharedSimulationTime(path)

    def now_ns(self, real_ns: int, speed: float) -> int:
        """Return the experiment time, ns since the Unix epoch, at the moment `real_ns` of `time.monotonic_ns`."""
        return self.read().at(real_ns, speed)

    @contextmanager
    def late(self, speed: float, since: float | Publication | None = None) -> Iterator[None]:
        """Hold the time while the block runs; see `ExperimentClock.late`."""
        if isinstance(since, Publication):
            own = _OwnHold(_NEVER_NS + since.value)
        else:
            own = _OwnHold(_AT_ONCE_NS if since is None else int(min(since, _LATEST_S) * _NS_PER_S))
        self._own.append(own)
        self._declare(own, speed)
        try:
            yield
        finally:
            self._own.remove(own)
            self._withdraw(own, speed)

    def hold(self, speed: float) -> TimeHold:
        """Hold the time until `drop`: for a process that must not wait at the end of its hold, as `late` may."""
        return self._declare(_OwnHold(_AT_ONCE_NS), speed)

    @contextmanager
    def passing(self, speed: float) -> Iterator[None]:
        """Withdraw this thread's holds while the block runs."""
        mine = [own for own in self._own if own.thread == threading.get_ident()]
        for own in mine:
            self._withdraw(own, speed)
        try:
            yield
        finally:
            for own in mine:
                self._declare(own, speed)

    def published(self, what: Publication, speed: float) -> None:
        """Let the holds begin that begin with a publication."""
        if self.awaits(what):
            self._change(lambda shared: shared.with_published(what), speed)

    def awaits(self, what: Publication) -> bool:
        """Return whether a receiver has declared a hold that begins with a publication."""
        return any(one.from_ns == _NEVER_NS + what.value for one in self.read().holds)

    def drop(self, hold: TimeHold, speed: float) -> bool:
        """Drop a hold of any process; return False if the file is in use, since its user may hang."""
        with self._turn, unless_locked(self._file) as is_free:
            if is_free:
                self._write(lambda shared: shared.without_hold(hold), speed)
        return is_free

    def read(self) -> SharedTime:
        for look in range(_LOOKS):
            packed, (before, shared) = self._map[:], self._last
            if packed == before:
                return shared
            if packed.endswith(_UNCHANGING) and (found := SharedTime.from_bytes(packed)) is not None:
                self._last = packed, found
                return found
            if look >= _LOOKS_AT_ONCE:
                time.sleep(_LOOK_S)  # no event: a byte in memory that another process changes
        return self._content()

    def _content(self) -> SharedTime:
        # also of a change that was not finished, unless it was written in part only
        return SharedTime.from_bytes(self._map[:]) or self._last[1]

    def _declare(self, own: _OwnHold, speed: float) -> TimeHold:
        def add(shared: SharedTime) -> SharedTime:
            # later than all others, since the clock of Windows stands for milliseconds
            begun_ns = max((shared.real_ns, *(one.begun_ns + 1 for one in shared.holds)))
            own.hold = TimeHold(begun_ns, own.from_ns, 0, os.getpid())
            return shared.with_hold(own.hold)

        self._change(add, speed)
        assert own.hold is not None
        return own.hold

    def _withdraw(self, own: _OwnHold, speed: float) -> None:
        hold, own.hold = own.hold, None
        if hold is not None and not self._file.closed:  # else it ends with its process
            self._change(lambda shared: shared.without_hold(hold), speed)

    def _change(self, change: Callable[[SharedTime], SharedTime], speed: float) -> None:
        with self._turn, locked(self._file):
            self._write(change, speed)

    def _write(self, change: Callable[[SharedTime], SharedTime], speed: float) -> None:
        before, end = self._content(), len(self._map)
        self._map[end - 1 :] = _CHANGING
        try:
            shared = change(before.moved_to(time.monotonic_ns(), speed)).settled()
            self._map[: end - 1] = shared.as_bytes()
        finally:
            self._map[end - 1 :] = _UNCHANGING


def opened(path: str | None) -> SharedSimulationTime | None:
    """Return the shared time of a run; None without one, once its file is gone with the run, or is cut off."""
    with suppress(OSError, ValueError):  # a full disk cuts a file off
        return SharedSimulationTime(Path(path)) if path else None
    return None
