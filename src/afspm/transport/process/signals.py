"""Ctrl-C and related signals as events of a poller."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

CTRL_C = ("SIGINT",)
ENDING = (*CTRL_C, "SIGTERM", "SIGBREAK", "SIGHUP")
"""SIGBREAK: Ctrl-Break, or a closed console, of Windows. SIGHUP: a closed terminal of POSIX."""


@contextmanager
def caught(tell: Callable[[int], None], wakeup_fd: int, names: Sequence[str] = ENDING) -> Iterator[None]:
    """Call `tell` with the number of each signal of `names` in the `with` block; a signal also writes to `wakeup_fd`.

    An ignored signal (SIGHUP under nohup) stays ignored. Outside the main thread this function has no effect, since
    Python delivers no signals there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, _frame: FrameType | None) -> None:
        tell(number)

    before = {}
    for number in (getattr(signal, name) for name in names if hasattr(signal, name)):
        if signal.getsignal(number) is not signal.SIG_IGN:
            before[number] = signal.signal(number, handle)
    # Windows runs handlers only after the main thread's wait: a byte in this descriptor ends the wait
    fd_before = signal.set_wakeup_fd(wakeup_fd, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(fd_before)
        for number, handler in before.items():
            signal.signal(number, handler)
