"""Work beside everything else, in a thread that no process waits for at its end."""

from __future__ import annotations

from collections.abc import Callable
from threading import Thread


def in_background(work: Callable[[], None]) -> None:
    """Run a function in a thread of its own; it reports its errors itself."""
    # not an executor's thread: those are waited for when the process ends
    Thread(target=work, daemon=True, name="background").start()
