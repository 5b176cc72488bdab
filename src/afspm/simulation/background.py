"""Background work in a thread that does not delay the end of the process."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


def in_background(work: Callable[[], None]) -> None:
    """Run a function in its own thread; the function must handle its errors."""
    # not an executor, whose threads delay the end of the process
    Thread(target=work, daemon=True, name="background").start()
