"""The folder that an agent writes into, seen from the bench, which is not sealed: bounded, and opened with care.

An agent may leave anything there: a pipe, on whose opening a reader waits for ever, a link to an endless device, or
more than the memory or the disk can hold.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from afspm.basics import FileError

MOST_BYTES: Final = 1 << 30
"""Size of a folder, and of each file in it, beyond which a trial ends."""
_MOST_ENTRIES: Final = 100_000
LEAST_FREE: Final = 256 << 20
"""Free bytes of the disk, below which a trial ends: files that were removed are open, but in no folder."""
_LOOK_S: Final = 0.5
# Windows has neither, and seals no agents
_CAREFUL: Final = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)


def read_left(file: Path, most: int) -> bytes:
    """Return the content of a file that an agent has left.

    Raises:
        FileNotFoundError: there is no such file.
        FileError: it is no regular file, it is larger than `most` bytes, or it can't be read.
    """
    try:
        opened = os.open(file, os.O_RDONLY | _CAREFUL)
        try:
            if not stat.S_ISREG(os.fstat(opened).st_mode):
                raise FileError("is no regular file", where=file.name)
            with os.fdopen(opened, "rb", closefd=False) as stream:
                content = stream.read(most + 1)
        finally:
            os.close(opened)
    except FileNotFoundError:
        raise
    except OSError as error:  # of a link, a socket, or a file without rights
        raise FileError(f"can't be read: {error.strerror}", where=file.name) from error
    if len(content) > most:
        raise FileError(f"is larger than {most} bytes", where=file.name)
    return content


@contextmanager
def watched(folder: Path, end: Callable[[], None]) -> Iterator[None]:
    """Call `end` once a folder is larger than an agent's folder may be, while the block runs.

    Raises:
        FileError: at the end of the block, if the folder is or was too large.
    """
    found: list[FileError] = []
    is_over = threading.Event()

    def look() -> None:
        try:
            require_bounds(folder)
        except FileError as error:
            found.append(error)

    def watch() -> None:
        while not found and not is_over.wait(_LOOK_S):
            look()
        if found:
            end()

    thread = threading.Thread(target=watch, name="folder", daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        look()
        if found:
            raise found[0]


def require_bounds(folder: Path) -> None:
    """Raise FileError if an agent's folder, or what else it may have written, is too large."""
    if (free := shutil.disk_usage(folder).free) < LEAST_FREE:
        raise FileError(f"the disk has only {free >> 20} MiB left", where=str(folder), hint=f"{LEAST_FREE >> 20} MiB")
    size, entries, left = 0, 0, [str(folder)]
    while left:
        try:
            with os.scandir(left.pop()) as found:
                for one in found:
                    entries += 1
                    size += _size(one)
                    if one.is_dir(follow_symlinks=False):
                        left.append(one.path)
                    if size > MOST_BYTES or entries > _MOST_ENTRIES:
                        raise FileError(
                            f"the agent's folder has more than {MOST_BYTES >> 20} MiB or {_MOST_ENTRIES} files",
                            where=str(folder),
                        )
        except FileNotFoundError:
            continue  # removed meanwhile
        except OSError as error:
            what = f"the agent's folder can't be measured: {error.strerror}"
            raise FileError(what, where=str(folder)) from error


def _size(one: os.DirEntry[str]) -> int:
    try:
        found = one.stat(follow_symlinks=False)
    except FileNotFoundError:
        return 0
    return getattr(found, "st_blocks", 0) * 512  # of a file with holes only what it takes


def remove(folder: Path) -> None:
    """Remove a folder with its content as far as possible."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except RecursionError:  # an agent has nested a thousand folders
        subprocess.run(["rm", "-rf", "--", str(folder)], check=False)
