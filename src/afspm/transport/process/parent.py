"""The bond to the process that started us: its end of our standard input.

It closes when the parent wants us to stop, and when the parent dies, however it dies: on every system.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable

END_WITHIN_S = 1.5
TIP_WITHIN_S = 14.0  # with a tip to see to first: its controller may answer slowly, or have to be found again
_STDIN = 0
_CHUNK = 1 << 16


def leave_interrupts_to_parent() -> None:
    """Ignore Ctrl-C, and Ctrl-Break of Windows: they reach the whole terminal, and the parent decides what they end."""
    for name in ("SIGINT", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def take_standard_input() -> int:
    """Return a descriptor of standard input that is ours alone, and leave an empty one in its place.

    On Windows, what is asked of a pipe waits for a read of it to end, in whatever thread: with a thread that reads
    descriptor 0, a library that only looks at its standard input (numpy's does) would never be loaded.
    """
    pipe = os.dup(_STDIN)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, _STDIN)
    os.close(nothing)
    sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: SIM115, PTH123 - as long as the process lives
    return pipe


def read_launch_line(pipe: int) -> bytes:
    """Return the first line of a pipe; empty if it ends before one came.

    Read past Python's own buffering: a thread that waits in that one would block the end of the interpreter.
    """
    line = bytearray()
    while (chunk := os.read(pipe, _CHUNK)) and b"\n" not in chunk:
        line += chunk
    return bytes(line + chunk).partition(b"\n")[0]


class StopRequested(BaseException):
    """The parent has gone or wants us to stop.

    Not an `Exception`, like KeyboardInterrupt: a script's `except Exception` must not keep a process alive.
    """


class ParentWatch:
    """Watches the parent, and calls what was registered, from another thread, when it has gone or lets us go.

    A process that has not ended `END_WITHIN_S` later (a handler that computes, a library that hangs) is ended the hard
    way, with `code_if_late`; if the tip is in danger, `TIP_WITHIN_S` later.

    Args:
        pipe: the descriptor that the parent holds the other end of.
    """

    def __init__(self, pipe: int, code_if_late: int) -> None:
        self._pipe = pipe
        self._code = code_if_late
        self._tip_in_danger: Callable[[], bool] = lambda: False
        self._callbacks: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._gone = threading.Event()

    def watch(self) -> None:
        """Begin; returns at once."""
        threading.Thread(target=self._watch, name="parent", daemon=True).start()

    @property
    def gone(self) -> bool:
        return self._gone.is_set()

    def when_gone(self, callback: Callable[[], None]) -> None:
        """Register what to call: at once, if the parent has gone already."""
        with self._lock:
            self._callbacks.append(callback)
            gone = self.gone
        if gone:
            callback()

    def tip_in_danger(self, whether: Callable[[], bool]) -> None:
        """Register what tells whether it is; it is called once, from another thread."""
        self._tip_in_danger = whether

    def let_go(self) -> None:
        """Behave as if the parent had gone. May be called from a signal handler."""
        threading.Thread(target=self._went, name="let-go", daemon=True).start()

    def _watch(self) -> None:
        try:
            while os.read(self._pipe, _CHUNK):
                pass  # nothing more is said to us; it is only held open
        except OSError:
            pass
        self._went()

    def _went(self) -> None:
        with self._lock:
            if self.gone:
                return
            self._gone.set()
            callbacks = tuple(self._callbacks)
        end_within(TIP_WITHIN_S if self._tip_in_danger() else END_WITHIN_S, self._code)
        for callback in callbacks:
            callback()


def end_within(seconds: float, code: int) -> None:
    """End the process with `code` in `seconds`, whatever it is doing then."""
    # a thread of its own and not a signal: there is no alarm on Windows
    timer = threading.Timer(seconds, os._exit, (code,))
    timer.daemon = True
    timer.start()
