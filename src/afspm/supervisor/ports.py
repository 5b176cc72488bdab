"""Addresses for sockets that the experiment file leaves open: unix sockets in one folder, or free ports.

Only the user who runs the experiment can enter the folder (mode 0700, independent of umask). The run's folder is
not used: the path of a unix socket has at most 107 bytes, and run folders are deep, and sometimes on a network disk.
"""

from __future__ import annotations

import errno
import os
import random
import re
import shutil
import socket
import sys
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from afspm.basics.addresses import LOOPBACK
from afspm.basics.errors import ConfigError
from afspm.transport.network import HAS_PRIVATE_SOCKETS

# Below the range from which systems take the ports of outgoing connections (Linux from 32768, Windows and macOS from
# 49152). A port within that range could be lost: while its process restarts, a peer that reconnects may get that very
# port as its own outgoing port, connect to itself, and keep the process from binding it.
LOWEST, HIGHEST = 20_000, 32_000
TRIES = 200
CAN_HOLD = sys.platform == "linux"
"""Whether a port can be held for a child: other systems let no second process bind a held port."""
LONGEST_FOLDER = 82
"""Longest path in which a folder of sockets is made, in bytes.

macOS has the lowest limit for a socket, 103, and the folder and a socket take up to 21.
"""
# limits the open descriptors of a process that chooses ports for many runs
_MOST_HELD = 256
# measured: the supervisor of 5 processes has 65 files open, of 9 processes 87; no other process of the run has more
FILES_AT_LEAST, FILES_OF_EACH = 64, 8
LEAST_MEMORY_BYTES = 1536 << 20  # measured: 1.33 to 1.40 GB of addresses, most of them for the threads' own use
_TCP = re.compile(r"tcp://(\*|[^:/\s]+|\[[0-9A-Fa-f:.]+\]):([1-9]\d*)")

_held: deque[int] = deque()  # descriptors, open as long as this process lives


class FreePorts:
    """An allocator of free ports of this computer, each used once.

    A port is chosen here and bound by the child, so that a restarted child has the same address. On Linux the port is
    held meanwhile: other programs that look for free ports, such as a second experiment, skip it before the child has
    bound it and while the child restarts. On other systems another program may take it; the child then fails to bind,
    and logs the failure.
    """

    def __init__(self, host: str = "127.0.0.1") -> None:
        self._host = host
        self._given: set[int] = set()
        self._random = random.Random()

    def take(self) -> int:
        """Return a port that was free just now.

        Raises:
            OSError: no port is free.
        """
        for _ in range(TRIES):
            port = self._random.randrange(LOWEST, HIGHEST)
            if port not in self._given and _is_free(self._host, port):
                self._given.add(port)
                return port
        raise OSError(f"no free port between {LOWEST} and {HIGHEST} on {self._host}")

    def address(self) -> str:
        """Return a free address in ZeroMQ's form."""
        return f"tcp://{self._host}:{self.take()}"


class SocketFolder:
    """Unix sockets in a new folder that only its owner can enter. Raises OSError if no folder can be made."""

    def __init__(self) -> None:
        self.path = _private_folder()
        self._count = 0

    def address(self) -> str:
        """Return an unused address."""
        self._count += 1
        return f"ipc://{self.path}/{self._count}"

    def close(self) -> None:
        """Remove the folder, with sockets that killed processes have left in it."""
        shutil.rmtree(self.path, ignore_errors=True)


def _private_folder() -> Path:
    # XDG_RUNTIME_DIR is preferred: it has mode 0700, and the system empties it after the login session.
    tried = [os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir(), "/tmp"]
    for parent in filter(None, tried):
        if len(os.fsencode(parent)) <= LONGEST_FOLDER and os.access(parent, os.W_OK | os.X_OK):
            return Path(tempfile.mkdtemp(prefix="afspm-", dir=parent))
    raise OSError(f"no folder for sockets can be made in {', '.join(filter(None, tried))}")


class NewAddresses(NamedTuple):
    """Functions that return a new address at each call: for sockets that the file leaves open, and for heartbeats."""

    of_socket: Callable[[], str]
    of_heartbeat: Callable[[], str]


@contextmanager
def new_addresses(*, private: bool, tcp: bool) -> Iterator[NewAddresses]:
    """Make addresses for a run, valid within the block. Raises ConfigError if no folder for sockets can be made.

    Args:
        private: use unix sockets where the system has them. Heartbeats, which stay on this computer, use them whenever
            `tcp` is false.
        tcp: use ports only.
    """
    ports = FreePorts()
    if tcp or not HAS_PRIVATE_SOCKETS:
        yield NewAddresses(ports.address, ports.address)
        return
    try:
        folder = SocketFolder()
    except OSError as error:
        what = f"the run's sockets have no place: {error}"
        raise ConfigError(what, hint="set XDG_RUNTIME_DIR to a folder of yours with a short path") from error
    try:
        yield NewAddresses(folder.address if private else ports.address, folder.address)
    finally:
        folder.close()


def require_free(bound: Mapping[str, str]) -> None:
    """Require that the addresses of an experiment are free, and hold their ports where the system allows.

    Args:
        bound: address -> name of the process that will bind it here.

    Raises:
        ConfigError: another program listens at one of the addresses.
    """
    for address, name in bound.items():
        if (found := _TCP.fullmatch(address)) and not _can_be_bound(found[1].strip("[]"), int(found[2])):
            what = f"[{name}] another program listens at {address}"
            raise ConfigError(what, hint="an experiment that still runs? end it, or give this one other addresses")


def _can_be_bound(host: str, port: int) -> bool:
    # false for a port in use or reserved; the process that binds the address reports any other error better
    host = {"*": "0.0.0.0", "localhost": LOOPBACK}.get(host, host)
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            if sys.platform == "win32":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
            else:  # connections of an earlier experiment may linger in TIME_WAIT
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            if CAN_HOLD:
                _hold(probe)
    except OSError as error:
        return error.errno not in (errno.EADDRINUSE, errno.EACCES)
    return True


def _is_free(host: str, port: int) -> bool:
    # where possible the port stays bound from here on, so that no other program takes it before our process binds it
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
        if CAN_HOLD:
            _hold(probe)
    return True


def _hold(bound: socket.socket) -> None:
    # bound exclusively first, and made shareable only then: our children bind it shared and listen
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    _held.append(bound.detach())
    if len(_held) > _MOST_HELD:
        os.close(_held.popleft())


def require_limits(processes: int) -> None:
    """Require the system's limits of a process to leave enough files and memory for a run.

    The limit of open files is raised as far as it may be and the run needs it.

    Raises:
        ConfigError: a limit is too low. ZeroMQ would end a process at its limit without a word of afspm.
    """
    if sys.platform == "win32":  # which has no such limits
        return
    import resource

    endless = resource.RLIM_INFINITY
    memory, _ = resource.getrlimit(resource.RLIMIT_AS)
    if memory != endless and memory < LEAST_MEMORY_BYTES:
        what = f"a process may use {memory >> 20} MiB of addresses here, and a run needs {LEAST_MEMORY_BYTES >> 20} MiB"
        raise ConfigError(what, hint="raise the limit, as with `ulimit -v unlimited`")
    needed = FILES_AT_LEAST + FILES_OF_EACH * processes
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == endless or soft >= needed:
        return
    if hard != endless and hard < needed:
        what = f"a process may open {hard} files here, and this run of {processes} processes needs {needed}"
        raise ConfigError(what, hint="raise the limit, as with `ulimit -n 1024`")
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
