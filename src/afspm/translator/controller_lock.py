"""A lock on a controller, held by one run's translator process until the process ends."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

from afspm.basics.errors import AfspmError
from afspm.basics.file_lock import lock

_LOCKED_BYTES = 1  # Windows lets no other process read locked bytes: the holder's name stands behind them


class ControllerTaken(AfspmError):
    """The error that another run commands the controller."""

    code = "controller-taken"


@contextlib.contextmanager
def commanding(address: str, run: str) -> Iterator[None]:
    """Lock the controller against all other processes and users of this computer, within the `with` block.

    Args:
        address: address of the controller; empty: no lock is needed, since no other process can command the controller.
        run: the folder of this run, shown to refused runs.

    Raises:
        ControllerTaken: another process commands the controller, or the lock file can't be opened.
    """
    if not address:
        yield
        return
    path = _lock_file(address)
    with _open_and_lock(path, address) as file:
        # a full disk, or a file of another user: the holder's name is missing, but the lock is held all the same
        with contextlib.suppress(OSError):
            file.truncate(0)
            file.write(b" " * _LOCKED_BYTES + f"{run or 'another run'}, process {os.getpid()}".encode())
            file.flush()
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # Windows keeps an open file; a sticky folder keeps another user's
                path.unlink()


def _open_and_lock(path: Path, address: str) -> BinaryIO:
    while True:
        try:
            file = _open_lock_file(path)
        except FileNotFoundError:
            continue  # its former holder has just deleted it
        except OSError as error:
            message = f"the lock file of this controller can't be opened: {error.strerror or error}"
            raise ControllerTaken(
                message, where=str(path), hint="find out which program made it, then delete it"
            ) from error
        try:
            lock(file)
            # between open and lock its former holder may have deleted it: then the lock is on no file of this name
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except FileNotFoundError:
            pass
        except OSError as error:
            file.close()
            message = f"another run already commands this controller: {_holder(path)}"
            raise ControllerTaken(
                message, where=address, hint="a controller takes commands from one run at a time: end that run first"
            ) from error
        file.close()


def _open_lock_file(path: Path) -> BinaryIO:
    # a link is not followed; a file of another user can be locked, but not written
    # O_NONBLOCK: a FIFO in its place must not block the open
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
    try:
        descriptor, mode = os.open(path, os.O_RDWR | os.O_CREAT | flags, 0o644), "r+b"
    except PermissionError:
        descriptor, mode = os.open(path, os.O_RDONLY | flags), "rb"
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file")
    return cast("BinaryIO", os.fdopen(descriptor, mode))


def _lock_file(address: str) -> Path:
    # one file for all spellings of an address
    plain = address.lower().replace("localhost", "127.0.0.1")
    return _lock_folder() / hashlib.sha256(plain.encode()).hexdigest()[:16]


def _lock_folder() -> Path:
    # common to all users: each may add files, and delete only their own (sticky bit). A link in its place is refused:
    # it may lead into a folder chosen by another user. The user who made the folder first, of several who measure here,
    # could rename the files of others: the lock prevents mistakes, and each local user can open the controller's port
    in_common = {
        "win32": os.environ.get("PROGRAMDATA"),
        "darwin": "/tmp",
    }  # where the temporary folder is each user's own
    folder = Path(in_common.get(sys.platform) or tempfile.gettempdir()) / "afspm-controllers"
    try:
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            folder.chmod(0o1777)
        if not stat.S_ISDIR(folder.lstat().st_mode):
            raise NotADirectoryError(errno.ENOTDIR, "it is not a folder")
    except OSError as error:
        message = f"the folder of the controllers' lock files can't be made: {error.strerror or error}"
        raise ControllerTaken(
            message, where=str(folder), hint="find out which program made it, then delete it"
        ) from error
    return folder


def _holder(path: Path) -> str:
    with contextlib.suppress(OSError), _open_lock_file(path) as file:
        file.seek(_LOCKED_BYTES)
        return file.read().decode(errors="replace") or "another run"
    return "another run"
