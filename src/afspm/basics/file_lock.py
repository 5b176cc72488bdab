"""Locks on files, by flock on POSIX systems and msvcrt on Windows."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO


def lock(file: IO[bytes], *, shared: bool = False, wait: bool = False) -> None:
    """Lock a file until it is closed.

    Args:
        shared: several processes may hold the lock (not on Windows).
        wait: wait until another process releases the lock, on Windows for at most ten seconds.

    Raises:
        OSError: another process holds the lock, with `wait` on Windows even after ten seconds.
    """
    if sys.platform == "win32":
        import msvcrt

        # Windows locks bytes from the present position on: the first byte stands for the file
        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))


@contextmanager
def locked(file: IO[bytes]) -> Iterator[None]:
    """Wait for the lock of a file, hold it in the block, and release it."""
    lock(file, wait=True)
    try:
        yield
    finally:
        _unlock(file)


@contextmanager
def unless_locked(file: IO[bytes]) -> Iterator[bool]:
    """Hold the lock of a file in the block if it is free; yield whether it is."""
    try:
        lock(file)
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        _unlock(file)


def _unlock(file: IO[bytes]) -> None:
    if sys.platform == "win32":
        import msvcrt

        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_UN)
