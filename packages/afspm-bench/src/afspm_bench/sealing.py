"""Sealing: a process denies itself all files but those it is given, with Landlock (Linux 6.2 and later).

    python -P -m afspm_bench.sealing SEAL_AS_JSON COMMAND…

Landlock rules only allow, for a folder with everything inside. So only the files that an agent needs have a rule: the
operating system, the interpreter and the agent's own modules to read and to execute, and one folder to write. All child
processes inherit the restriction. The memory of other processes is denied, too, and where the kernel can, signals to
them. Not denied: connections to sockets, the environment of other processes, which must therefore hold no secret, and
sizes and permissions of files whose path is known.

The process that was started stays outside the seal, and attends to the sealed one: the kernel gives it the processes
that the sealed one leaves behind, in sessions of their own, too, and it kills them at the end. SIGTERM ends all.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import struct
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, NoReturn

from afspm.basics import AfspmError

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls, the same on all architectures
_VERSION_FLAG: Final = 1
_BENEATH: Final = 1
_NO_NEW_PRIVS: Final = 38
_CHILD_SUBREAPER: Final = 36
_EXECUTE, _WRITE, _READ_FILE, _LIST = (1 << bit for bit in range(4))
_TRUNCATE: Final = 1 << 14
_READ: Final = _EXECUTE | _READ_FILE | _LIST
_DEVICES: Final = 1 << 6 | 1 << 11  # make a character or block device: root could read its disk by a new name
_FILE_RIGHTS: Final = _EXECUTE | _WRITE | _READ_FILE | _TRUNCATE
_RIGHTS: Final = (1 << 15) - 1
"""All rights on files of the third version of the kernel's interface."""
_IOCTL: Final = 1 << 15  # on devices, since the fifth version
_SCOPES: Final = 0b11  # abstract Unix sockets and signals of processes outside, since the sixth version
_LEAST_VERSION: Final = 3  # the second can't deny truncation: a judge cut short in its file may be a milder judge
_IOCTL_VERSION, _SCOPE_VERSION = 5, 6
_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/etc", "/nix/store", "/proc", "/sys")
# links that may lead out of the folders above
_LINKED = ("/etc/resolv.conf", "/etc/localtime", "/etc/hosts")
_SOURCES = ("/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")


class SealingFailed(AfspmError):
    """Error: the kernel can't seal a process."""

    code = "sealing-failed"


@dataclass(frozen=True)
class Seal:
    """The files that a sealed process may use, besides those of the operating system; all others are denied.

    Attributes:
        own: folder in which the process may do everything.
        readable: files and folders to read and execute.
        most_bytes: size of the largest file that it may write.
    """

    own: str
    readable: tuple[str, ...]
    most_bytes: int = 1 << 30

    def command(self, python: Sequence[str], command: Sequence[str]) -> tuple[str, ...]:
        """Return the command that starts `command` sealed.

        Args:
            python: the command that runs this module.
        """
        return (*python, json.dumps(asdict(self)), *command)


def unavailable() -> str:
    """Return the reason why this computer can't seal a process; empty if it can."""
    version = _version()
    if version < 1:
        return "it has no Landlock"
    if version < _LEAST_VERSION:
        return f"its Landlock has version {version}, which can't keep a process from cutting files short"
    return ""


def interpreter_folders() -> list[str]:
    """Return the folders in which this process's Python finds its programs, its library and installed packages."""
    found = [sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values(), *sys.path]
    return [path for path in dict.fromkeys(found) if path]


def seal(given: Seal) -> None:
    """Deny this process and its children all files but the given ones, permanently.

    Raises:
        SealingFailed: Landlock is missing or too old, or refuses a rule.
    """
    if why := unavailable():
        raise SealingFailed(f"this computer can't seal a process: {why}", hint="Linux 6.2 or later")
    libc, version = _libc(), _version()
    rights = _RIGHTS | (_IOCTL if version >= _IOCTL_VERSION else 0)
    plain = struct.pack("<QQQ", rights, 0, _SCOPES) if version >= _SCOPE_VERSION else struct.pack("<Q", rights)
    rules = libc.syscall(_CREATE, ctypes.create_string_buffer(plain, len(plain)), len(plain), 0)
    _require(rules, "create a ruleset")
    try:
        for path, allowed in _allowed(given, rights):
            _allow(libc, rules, path, allowed)
        _require(libc.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0), "give up new privileges")
        _require(libc.syscall(_RESTRICT, rules, 0), "restrict itself")
    finally:
        os.close(rules)


def _allowed(given: Seal, rights: int) -> Iterator[tuple[str, int]]:
    yield given.own, rights & ~(_DEVICES | _IOCTL)
    for path in (*_SYSTEM, *_LINKED, *_SOURCES, *given.readable):
        yield path, _READ
    yield "/dev/null", _READ_FILE | _WRITE | _TRUNCATE


def _allow(libc: ctypes.CDLL, rules: int, path: str, allowed: int) -> None:
    # no system has all of these folders, and a path that is not there needs no rule
    with contextlib.suppress(OSError):
        opened = os.open(path, os.O_PATH | os.O_CLOEXEC)
        try:
            allowed &= -1 if Path(path).is_dir() else _FILE_RIGHTS
            rule = ctypes.create_string_buffer(struct.pack("<Qi", allowed, opened), 12)
            _require(libc.syscall(_ADD, rules, _BENEATH, rule, 0), f"allow {path}")
        finally:
            os.close(opened)


def _require(result: int, what: str) -> None:
    if result < 0:
        raise SealingFailed(f"the kernel refuses to {what}: {os.strerror(ctypes.get_errno())}")


def _version() -> int:
    return int(_libc().syscall(_CREATE, None, 0, _VERSION_FLAG)) if sys.platform == "linux" else 0


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def main(arguments: Sequence[str]) -> int:
    """Run a command sealed; return its exit code once no process of it lives.

    Without arguments, print the folders of the interpreter.
    """
    if not arguments:
        sys.stdout.write(json.dumps(interpreter_folders()))
        return 0
    given, *command = arguments
    signal.signal(signal.SIGTERM, lambda *_: _kill_children())
    _require(_libc().prctl(_CHILD_SUBREAPER, 1, 0, 0, 0), "attend to the processes of a sealed one")
    if (child := os.fork()) == 0:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        _replace(Seal(**json.loads(given)), command)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the sealed one, too, and the bench
    return _attended(child)


def _replace(given: Seal, command: list[str]) -> NoReturn:
    import resource  # not on Windows, where this module is imported, too

    resource.setrlimit(resource.RLIMIT_FSIZE, (given.most_bytes, given.most_bytes))
    seal(given)
    try:
        os.execvp(command[0], command)
    except OSError as error:
        sys.exit(
            f"{command[0]} can't be started by a sealed process: {error.strerror}; if the file is there, let the agent "
            "read its folder with --read"
        )


def _attended(child: int) -> int:
    code = None
    with contextlib.suppress(ChildProcessError):  # none is left
        while True:
            ended, status = os.wait()
            if ended == child:
                code = os.waitstatus_to_exitcode(status)
            if code is not None:
                _kill_children()  # processes whose parent has ended since the last look are children of this one now
    return 1 if code is None or code < 0 else code


def _kill_children() -> None:
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            parent = (process / "stat").read_bytes().rpartition(b")")[2].split()[1]
            if int(parent) == os.getpid():
                os.kill(int(process.name), signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
