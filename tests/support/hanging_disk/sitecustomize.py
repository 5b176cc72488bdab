"""A disk that hangs, in a real process.

No file below HANGING_FOLDER is opened, written or synced while `<folder>.hangs` exists. Python imports this module at
its start if its folder is in PYTHONPATH.
"""

from __future__ import annotations

import builtins
import io
import os
import time
from collections.abc import Callable
from typing import Any

FOLDER = os.environ["HANGING_FOLDER"]
SWITCH = f"{FOLDER}.hangs"
_exists, _readlink = os.path.exists, os.readlink


def wait_for_disk(of: Any) -> None:
    """Wait while the disk of a path, or of an open file, hangs."""
    path = _readlink(f"/proc/self/fd/{of}") if isinstance(of, int) else os.fspath(of)
    while str(path).startswith(FOLDER) and _exists(SWITCH):
        time.sleep(0.01)


class SlowFile(io.FileIO):
    """A file whose writes wait for its disk."""

    def write(self, data: Any) -> int:
        wait_for_disk(self.fileno())
        return super().write(data)


def slow(call: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a system function so that it waits for the disk of its first argument."""

    def called(of: Any, *arguments: Any, **options: Any) -> Any:
        wait_for_disk(of)
        return call(of, *arguments, **options)

    return called


_open = io.open


def opened(file: Any, mode: str = "r", buffering: int = -1, *arguments: Any, **options: Any) -> Any:
    if isinstance(file, int) or not str(file).startswith(FOLDER):
        return _open(file, mode, buffering, *arguments, **options)
    wait_for_disk(file)
    if not set(mode) & set("wax+"):
        return _open(file, mode, buffering, *arguments, **options)
    raw = SlowFile(os.fspath(file), mode.replace("b", "").replace("t", ""), opener=options.pop("opener", None))
    if buffering == 0:
        return raw
    binary = io.BufferedWriter(raw)
    return binary if "b" in mode else io.TextIOWrapper(binary, *arguments, **options)


io.open = builtins.open = opened
io.FileIO = SlowFile  # type: ignore[misc]
for name in ("fsync", "fdatasync", "mkdir", "replace", "rename", "unlink", "open"):
    setattr(os, name, slow(getattr(os, name)))
