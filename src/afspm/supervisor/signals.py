"""Ctrl-C and its relatives, as events of the supervisor's poller."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from afspm.logic.supervision.supervisor_events import EndSignal

# SIGBREAK is Windows' Ctrl-Break and the closing of its console, SIGHUP that of a POSIX terminal
_NAMES = ("SIGINT", "SIGTERM", "SIGBREAK", "SIGHUP")


@contextmanager
def caught(tell: Callable[[EndSignal], None], wakeup_fd: int) -> Iterator[None]:
    """Hand signals that end a program to `tell` instead, while in this block; write to `wakeup_fd` with each.

    A signal that is ignored already (SIGHUP under nohup) stays ignored. Away from the main thread Python gives no
    signals: then this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _frame: FrameType | None) -> None:
        tell(EndSignal(number))

    before = {}
    for number in (getattr(signal, name) for name in _NAMES if hasattr(signal, name)):
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, handle)
    # Windows runs handlers only when the main thread comes back from waiting: this is what brings it back
    fd_before = signal.set_wakeup_fd(wakeup_fd, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(fd_before)
        for number, handler in before.items():
            signal.signal(number, handler)
