"""One run at a time commands a controller: its translator holds a lock, which the system takes back from the dead."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from afspm.errors import AfspmError
from afspm.record.going_on import lock

_LOCKED_BYTES = 1  # where a lock covers what is read (Windows), who holds it is told behind it


class ControllerTaken(AfspmError):
    """Another run commands the controller."""

    code = "controller-taken"


@contextlib.contextmanager
def commanding(address: str, run: str) -> Iterator[None]:
    """This process alone, of all of this user on this computer, commands the controller while in the block.

    Args:
        address: where the controller is; empty: nobody else can command it (a simulated one).
        run: in which run, for whoever is refused.

    Raises:
        ControllerTaken: another process does.
    """
    if not address:
        yield
        return
    path = _file(address)
    with _locked(path, address) as file:
        with contextlib.suppress(OSError):  # a full disk: who holds it can't be told, and it is held all the same
            file.truncate(0)
            file.write(b" " * _LOCKED_BYTES + f"{run or 'another run'}, process {os.getpid()}".encode())
            file.flush()
        try:
            yield
        finally:
            with contextlib.suppress(OSError):  # Windows keeps it while it is open
                path.unlink()


def _locked(path: Path, address: str) -> BinaryIO:
    """The file, open, and locked by us. Raises ControllerTaken."""
    while True:
        file = path.open("a+b")
        try:
            lock(file)
            if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                return file
        except FileNotFoundError:
            pass  # whoever had it has just taken it away
        except OSError as error:
            file.close()
            told = f"this controller is commanded by {_holder(path)}"
            raise ControllerTaken(told, where=address, hint="one run at a time: end that one first") from error
        file.close()


def _file(address: str) -> Path:
    """The same for all processes of this user, however they write this computer."""
    plain = address.lower().replace("localhost", "127.0.0.1")
    user = getattr(os, "getuid", lambda: "")()  # on Windows the folder is the user's own
    return Path(tempfile.gettempdir()) / f"afspm-controller-{user}-{hashlib.sha256(plain.encode()).hexdigest()[:16]}"


def _holder(path: Path) -> str:
    with contextlib.suppress(OSError), path.open("rb") as file:
        file.seek(_LOCKED_BYTES)
        return file.read().decode(errors="replace") or "another run"
    return "another run"
