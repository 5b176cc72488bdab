"""A lock on a controller, held by one run's translator process until the process ends."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import socket
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, cast

from afspm.basics.errors import AfspmError
from afspm.basics.file_lock import lock

# not Python's temporary folder, which each user and each shell may set
_COMMON = (os.environ.get("PROGRAMDATA") or tempfile.gettempdir()) if sys.platform == "win32" else "/tmp"
_LOCKED_BYTES = 1  # Windows lets no other process read locked bytes: the holder's name stands behind them


class ControllerTaken(AfspmError):
    """The error that another run commands the controller."""

    code = "controller-taken"


@contextlib.contextmanager
def commanding(address: str, run: str) -> Iterator[Callable[[str], None]]:
    """Lock the controller against all other processes and users of this computer, within the `with` block.

    Another computer is locked as a whole. On this one, where several emulated controllers may run, the ports are
    locked, and the `identity` of the driver, since the controller may also listen on ports that `address` lacks.

    Args:
        address: address of the controller; empty: no lock is needed, since no other process can command the controller.
        run: the folder of this run, shown to refused runs.

    Yields:
        a function that locks the `identity`, once the driver is connected. Raises ControllerTaken.

    Raises:
        ControllerTaken: another process commands the controller, or the lock file can't be opened.
    """
    is_here, names = _names(address)
    held = set[str]()
    with contextlib.ExitStack() as stack:

        def take(name: str, where: str) -> None:
            if name not in held:
                stack.enter_context(_locked(name, where, run))
                held.add(name)

        def take_identity(identity: str) -> None:
            # the first one counts: a person may choose another folder, and a lost controller must be reached again
            if is_here and names and identity and held <= names:
                take(identity, f"{address}, {identity}")

        for name in sorted(names):  # in one order: of two runs that begin together, one gets them all
            take(name, address)
        yield take_identity


def is_elsewhere(address: str) -> bool:
    """Return whether a controller's address is one of another computer."""
    return not _names(address)[0]


def _names(address: str) -> tuple[bool, set[str]]:
    # whether the controller is on this computer, and the same names for all spellings of an address
    plain = "".join(address.lower().split())
    host, _, ports = plain.rpartition("://")[2].partition("/")[0].rpartition(":")
    if not (host and ports.replace(",", "").isdigit()):  # such as shared memory
        return True, {plain} if plain else set()
    host = host.strip("[]")
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError):  # unknown now, and perhaps known later
        return False, {host}
    if any(_is_here(family, at) for family, _, _, _, at in found):
        return True, {f"port {int(port)} of this computer" for port in ports.split(",") if port}
    return False, {host, *(str(at[0]) for _, _, _, _, at in found)}


def _is_here(family: int, at: tuple[object, ...]) -> bool:
    # only an address of this computer can be bound
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind(at)
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _locked(name: str, where: str, run: str) -> Iterator[None]:
    path = _lock_folder() / hashlib.sha256(name.encode()).hexdigest()[:16]
    with _open_and_lock(path, where) as file:
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


def _open_and_lock(path: Path, where: str) -> BinaryIO:
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
                message, where=where, hint="a controller takes commands from one run at a time: end that run first"
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


def _lock_folder() -> Path:
    # common to all users: each may add files, and delete only their own (sticky bit). A link in its place is refused:
    # it may lead into a folder chosen by another user. The user who made the folder first, of several who measure here,
    # could rename the files of others: the lock prevents mistakes, and each local user can open the controller's port
    folder = Path(_COMMON) / "afspm-controllers"
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
