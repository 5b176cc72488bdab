"""Sealing: deny an agent's process access to the folder of the microscope, with Landlock (Linux 5.13 and later).

    python -m afspm.plugins.bench.sealing SEALED_FOLDER KEPT_FILE… -- COMMAND…

Landlock rules only allow: all siblings along the path to the sealed folder are allowed, so the folder itself is denied
under any name. All child processes inherit the restriction. The memory of other processes is denied, too, but not
their environment, which must therefore hold no secret.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import struct
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from afspm.basics.errors import AfspmError

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls, the same on all architectures
_VERSION_FLAG: Final = 1
_BENEATH: Final = 1
_NO_NEW_PRIVS: Final = 38
_READ: Final = 0b1101  # execute, read a file, list a folder
_FILE_RIGHTS: Final = 0b0111 | 1 << 14  # rights that a rule on a single file can have
# rights known to each version of the kernel's interface
_RIGHTS: Final = {1: (1 << 13) - 1, 2: (1 << 14) - 1}
_NEWEST_RIGHTS: Final = (1 << 15) - 1


class SealingFailed(AfspmError):
    """Error: the kernel can't seal a process."""

    code = "sealing-failed"


def is_available() -> bool:
    """Return whether this computer can seal a process."""
    return sys.platform == "linux" and int(_libc().syscall(_CREATE, None, 0, _VERSION_FLAG)) >= 1


def seal(folder: Path, kept: Sequence[Path]) -> None:
    """Deny this process and its children all access to the files in `folder`, permanently.

    Args:
        kept: files in `folder` that stay readable and writable.

    Raises:
        SealingFailed: Landlock is missing, or refuses a rule.
    """
    libc = _libc()
    version = libc.syscall(_CREATE, None, 0, _VERSION_FLAG) if sys.platform == "linux" else -1
    if version < 1:
        raise SealingFailed("this computer has no Landlock", hint="Linux 5.13 or later; or run the bench unsealed")
    rights = _RIGHTS.get(version, _NEWEST_RIGHTS)
    attributes = ctypes.create_string_buffer(struct.pack("<Q", rights), 8)
    rules = libc.syscall(_CREATE, attributes, 8, 0)
    _require(rules, "create a ruleset")
    try:
        for path, allowed in _allowed(folder.resolve(), kept, rights):
            _allow(libc, rules, path, allowed)
        _require(libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0), "give up new privileges")
        _require(libc.syscall(_RESTRICT, rules, 0), "restrict itself")
    finally:
        os.close(rules)


def _allowed(folder: Path, kept: Sequence[Path], rights: int) -> Iterator[tuple[Path, int]]:
    for step in (folder, *folder.parents[:-1]):
        for sibling in step.parent.iterdir():
            # a rule on a link would allow its target, and some link leads to a folder above the sealed one
            if sibling != step and not sibling.is_symlink():
                yield sibling, rights if sibling.is_dir() else rights & _FILE_RIGHTS
    for file in kept:
        yield file, rights & _FILE_RIGHTS


def _allow(libc: ctypes.CDLL, rules: int, path: Path, allowed: int) -> None:
    # a sibling that vanishes needs no rule
    with contextlib.suppress(OSError):
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            rule = ctypes.create_string_buffer(struct.pack("<Qi", allowed, opened), 12)
            _require(libc.syscall(_ADD, rules, _BENEATH, rule, 0), f"allow {path}")
        finally:
            os.close(opened)


def _require(result: int, what: str) -> None:
    if result < 0:
        raise SealingFailed(f"the kernel refuses to {what}: {os.strerror(ctypes.get_errno())}")


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def main(arguments: Sequence[str]) -> None:
    """Seal this process, then replace it by the command."""
    split = arguments.index("--")
    folder, *kept = map(Path, arguments[:split])
    seal(folder, kept)
    command = list(arguments[split + 1 :])
    os.execvp(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
