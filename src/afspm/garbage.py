"""Python looks for garbage in all that there is, again and again while that grows, and once more at the end: a fifth
of the time that a short command takes."""

from __future__ import annotations

import atexit
import gc


def seldom() -> None:
    """For a process that loads much and leaves little behind: garbage is looked for seldom, and not at the end."""
    gc.set_threshold(20_000, 10, 10)
    atexit.register(gc.freeze)


def loaded() -> None:
    """For one that has loaded what it needs: that is there to the end, and is not looked through any more."""
    gc.freeze()
