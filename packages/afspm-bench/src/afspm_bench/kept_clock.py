"""Clock of a sealed agent: the bench keeps it in a thread, and the agent asks over a socket.

**Theory of operation.** The processes of a run share simulated time in a file, in which each of them declares for how
long time waits for it. A process that may open this file can also cut it short or keep it locked, and stops the run by
that. So a sealed agent gets no file, but one end of a pair of sockets. A request has a fixed size, and the answer to
each request is the experiment time. The holds of an agent end with its trial.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from afspm.basics import NS_PER_S, Clock, InvalidValue, NoResponse, Publication

MOST_HOLDS: Final = 16
"""Holds of one agent at a time; a thread has one to three. The processes of the run share 64."""
_REQUEST: Final = struct.Struct("<bqq")  # the act, the number of the hold, its beginning in experiment time
_ANSWER: Final = struct.Struct("<q")
_REFUSED: Final = -(1 << 63)
_LATEST_S: Final = 4e9


class _Act(IntEnum):
    LOOK = 0
    HOLD = 1  # at once
    HOLD_FROM = 2
    HOLD_FROM_RESULTS = 3
    HOLD_FROM_LINES = 4
    RELEASE = 5


_PUBLISHED: Final = {_Act.HOLD_FROM_RESULTS: Publication.RESULTS, _Act.HOLD_FROM_LINES: Publication.LINES}


@contextmanager
def keeping(clock: Clock) -> Iterator[socket.socket]:
    """Yield the agent's end of a socket through which `KeptClock` reads a clock and holds it."""
    here, theirs = socket.socketpair()
    thread = threading.Thread(target=_answer, args=(clock, here), name="clock", daemon=True)
    thread.start()
    try:
        with theirs:
            yield theirs
    finally:
        with suppress(OSError):  # the thread has ended already
            here.shutdown(socket.SHUT_RDWR)
        thread.join()


def _answer(clock: Clock, here: socket.socket) -> None:
    holds: dict[int, ExitStack] = {}
    try:
        while request := _received(here, _REQUEST.size):
            act, number, from_ns = _REQUEST.unpack(request)
            here.sendall(_ANSWER.pack(_answered(clock, holds, _Act(act), number, from_ns)))
    except (OSError, ValueError):
        pass  # the agent has ended, or it sends other things than `KeptClock` does: it is served no longer
    finally:
        here.close()
        for hold in holds.values():
            hold.close()


def _answered(clock: Clock, holds: dict[int, ExitStack], act: _Act, number: int, from_ns: int) -> int:
    if act is _Act.RELEASE:
        holds.pop(number, ExitStack()).close()
    elif act is not _Act.LOOK:
        if number in holds or len(holds) == MOST_HOLDS:
            return _REFUSED
        since = from_ns / NS_PER_S if act is _Act.HOLD_FROM else _PUBLISHED.get(act)
        holds[number] = ExitStack()
        holds[number].enter_context(clock.late(since))
    return clock.now_ns()


def _received(here: socket.socket, size: int) -> bytes:
    # empty if the other end was closed
    received = b""
    while len(received) < size:
        if not (part := here.recv(size - len(received))):
            return b""
        received += part
    return received


@dataclass(eq=False)
class _Hold:
    """A hold of this process, and the thread that declared it."""

    number: int
    act: _Act
    from_ns: int
    thread: int = field(default_factory=threading.get_ident)


class KeptClock:
    """The agent's side: a `Clock` that asks the bench.

    Args:
        asked: the agent's end of the socket.
        speed: experiment seconds per real second.
    """

    def __init__(self, asked: socket.socket, speed: float) -> None:
        self._socket = asked
        self._speed = speed
        self._turn = threading.Lock()
        self._holds: list[_Hold] = []
        self._last = 0

    def now_ns(self) -> int:
        return self._ask(_Act.LOOK)

    def now_s(self) -> float:
        return self.now_ns() / NS_PER_S

    def monotonic_s(self) -> float:
        return time.monotonic()

    def real_s(self, experiment_s: float) -> float:
        return experiment_s / self._speed

    @contextmanager
    def late(self, since: float | Publication | None = None) -> Iterator[None]:
        """Hold simulated time down to real time while the block runs; see `ExperimentClock.late`.

        Raises:
            InvalidValue: the agent holds the time more than `MOST_HOLDS` times at once.
            NoResponse: the trial has ended.
        """
        if isinstance(since, Publication):
            act, from_ns = _Act.HOLD_FROM_RESULTS if since is Publication.RESULTS else _Act.HOLD_FROM_LINES, 0
        elif since is None:
            act, from_ns = _Act.HOLD, 0
        else:
            act, from_ns = _Act.HOLD_FROM, int(min(since, _LATEST_S) * NS_PER_S)
        with self._turn:
            self._last += 1
            hold = _Hold(self._last, act, from_ns)
        self._declare(hold)
        self._holds.append(hold)
        try:
            yield
        finally:
            self._holds.remove(hold)
            with suppress(NoResponse):  # it ended with the trial
                self._ask(_Act.RELEASE, hold.number)

    @contextmanager
    def passing(self) -> Iterator[None]:
        """Withdraw the holds of this thread while the block runs."""
        mine = [hold for hold in self._holds if hold.thread == threading.get_ident()]
        for hold in mine:
            self._ask(_Act.RELEASE, hold.number)
        try:
            yield
        finally:
            for hold in mine:
                self._declare(hold)

    def published(self, what: Publication) -> None:
        """Do nothing: an agent publishes no measurements."""

    def awaits(self, what: Publication) -> bool:
        return False

    def _declare(self, hold: _Hold) -> None:
        self._ask(hold.act, hold.number, hold.from_ns)

    def _ask(self, act: _Act, number: int = 0, from_ns: int = 0) -> int:
        with self._turn:
            try:
                self._socket.sendall(_REQUEST.pack(act, number, from_ns))
                packed = _received(self._socket, _ANSWER.size)
            except OSError:
                packed = b""
        if not packed:
            raise NoResponse("the bench no longer keeps the clock: the trial has ended")
        (answer,) = _ANSWER.unpack(packed)
        if answer == _REFUSED:
            raise InvalidValue(f"the time is held {MOST_HOLDS} times, as often as an agent may hold it at once")
        return int(answer)
