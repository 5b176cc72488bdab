"""The bond to the parent process: a pipe from the parent to the standard input of this process.

The pipe closes when the parent stops the process, and when the parent dies in any way, on every system. A program in
another language needs no library for that.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress

END_WITHIN_S = 1.5  # then the process is ended from outside of its handlers
TIP_WITHIN_S = 14.0  # time to withdraw the tip: the controller may answer slowly, or need a new connection
_STDIN = 0
_CHUNK = 1 << 16


def leave_interrupts_to_parent() -> None:
    """Ignore Ctrl-C and Windows' Ctrl-Break: they reach the whole terminal, and the parent ends its processes."""
    for name in ("SIGINT", "SIGBREAK"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def take_standard_input() -> int:
    """Return a private descriptor of standard input, and replace standard input by an empty one.

    On Windows, every operation on a pipe waits for a read of it in another thread. With a thread that reads descriptor
    0, a library that only inspects its standard input (as numpy's does) would never finish loading.
    """
    pipe = os.dup(_STDIN)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, _STDIN)
    os.close(nothing)
    sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: SIM115, PTH123 - as long as the process lives
    return pipe


def read_launch_line(pipe: int) -> bytes:
    """Return the first line of a pipe; empty if the pipe ends before.

    The read bypasses Python's buffered reader: a thread that waits in it would block the end of the interpreter.
    """
    line = bytearray()
    while (chunk := os.read(pipe, _CHUNK)) and b"\n" not in chunk:
        line += chunk
    return bytes(line + chunk).partition(b"\n")[0]


def call_at_signal(number: int, callback: Callable[[], object]) -> None:
    """Call a function in another thread at each signal of this number. To be called in the main thread, once.

    Python runs a handler between two of its own instructions. A signal that comes right before a wait in C would be
    noticed when the wait ends, perhaps never, and a handler that starts a thread hangs if the main thread is starting
    one. The descriptor is written to at once.
    """
    reader, writer = socket.socketpair()
    writer.settimeout(0)

    def tell(*_: object) -> None:  # again, if a library has replaced the descriptor
        with suppress(OSError):
            writer.send(bytes([number]))

    def listen() -> None:
        while heard := reader.recv(_CHUNK):
            if number in heard:
                callback()

    threading.Thread(target=listen, name="signals", daemon=True).start()
    signal.signal(number, tell)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)


class StopRequested(BaseException):
    """The exception raised when the parent has ended or stops the process.

    Like KeyboardInterrupt it is no `Exception`: a script's `except Exception` must not keep a process alive.
    """


class ParentWatch:
    """A watch over the parent, which runs callbacks in another thread when the parent dies or stops this process.

    If this process still runs `END_WITHIN_S` later (a handler computes, a library hangs), the watch ends the process
    with the exit code `code_if_late`. If the tip is in danger, the time limit is `TIP_WITHIN_S`.

    Args:
        pipe: descriptor of a pipe; the parent holds its other end.
    """

    def __init__(self, pipe: int, code_if_late: int) -> None:
        self._pipe = pipe
        self._code = code_if_late
        self._tip_in_danger: Callable[[], bool] = lambda: False
        self._callbacks: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._gone = threading.Event()

    def watch(self) -> None:
        """Start the watch, and return at once."""
        threading.Thread(target=self._watch, name="parent", daemon=True).start()

    @property
    def gone(self) -> bool:
        return self._gone.is_set()

    def when_gone(self, callback: Callable[[], None]) -> None:
        """Register a callback; call it at once if the parent is already gone."""
        with self._lock:
            self._callbacks.append(callback)
            gone = self.gone
        if gone:
            callback()

    def tip_in_danger(self, whether: Callable[[], bool]) -> None:
        """Register a function that returns whether the tip is in danger.

        The function is called at most once, from another thread.
        """
        self._tip_in_danger = whether

    def let_go(self) -> None:
        """Behave as if the parent had gone."""
        with self._lock:
            if self.gone:
                return
            self._gone.set()
            callbacks = tuple(self._callbacks)
        end_within(TIP_WITHIN_S if self._tip_in_danger() else END_WITHIN_S, self._code)
        for callback in callbacks:
            callback()

    def _watch(self) -> None:
        try:
            while os.read(self._pipe, _CHUNK):
                pass  # the parent writes nothing after the launch line
        except OSError:
            pass
        self.let_go()


def end_within(seconds: float, code: int) -> None:
    """End the process with `code` after `seconds`, even if it hangs."""
    # a thread, since Windows has no alarm signal
    timer = threading.Timer(seconds, os._exit, (code,))
    timer.daemon = True
    timer.start()
