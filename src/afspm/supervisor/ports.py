"""Free ports for the addresses that an experiment file leaves open."""

from __future__ import annotations

import errno
import os
import random
import re
import socket
import sys
from collections import deque
from collections.abc import Mapping

from afspm.addresses import LOOPBACK
from afspm.errors import ConfigError

# Below the range from which systems take the ports of outgoing connections (Linux from 32768, Windows and macOS from
# 49152). From within it a port would be no choice: while its process is being restarted, a peer that tries again and
# again may be given that very port by its own system, connect to itself, and keep the process from ever binding it.
LOWEST, HIGHEST = 20_000, 32_000
TRIES = 200
CAN_HOLD = sys.platform == "linux"
"""Elsewhere a port that one process has bound, without listening, can't be bound by another."""
_MOST_HELD = 256
_TCP = re.compile(r"tcp://(\*|[^:/\s]+|\[[0-9A-Fa-f:.]+\]):([1-9]\d*)")

_held: deque[int] = deque()  # files of sockets, for as long as this process lasts


class FreePorts:
    """Hands out ports of this computer that nobody listens on, each once.

    The port is chosen here and bound by the child, so that a restarted child is found where it was. On Linux it is held
    meanwhile: whoever else chooses ports, experiments beside this one for instance, does not find it free, neither
    before the child has bound it nor while the child is being restarted. On other systems another program may take it:
    the child then fails to bind and says so.
    """

    def __init__(self, host: str = "127.0.0.1") -> None:
        self._host = host
        self._given: set[int] = set()
        self._random = random.Random()

    def take(self) -> int:
        """Return a port that was free just now.

        Raises:
            OSError: none is to be had.
        """
        for _ in range(TRIES):
            port = self._random.randrange(LOWEST, HIGHEST)
            if port not in self._given and _is_free(self._host, port):
                self._given.add(port)
                return port
        raise OSError(f"no free port between {LOWEST} and {HIGHEST} on {self._host}")

    def address(self) -> str:
        """Return a free address for a socket, as ZeroMQ writes it."""
        return f"tcp://{self._host}:{self.take()}"


def require_free(bound: Mapping[str, str]) -> None:
    """See that the addresses of an experiment are free before anything is started, and hold them where that can be.

    Args:
        bound: address -> the name of the process that will bind it here.

    Raises:
        ConfigError: another program listens at one.
    """
    for address, name in bound.items():
        if (found := _TCP.fullmatch(address)) and not _can_be_bound(found[1].strip("[]"), int(found[2])):
            what = f"[{name}] another program listens at {address}"
            raise ConfigError(what, hint="an experiment that still runs? end it, or give this one other addresses")


def _can_be_bound(host: str, port: int) -> bool:
    """False only if somebody listens there; all else that is wrong with an address is said by who binds it."""
    host = {"*": "0.0.0.0", "localhost": LOOPBACK}.get(host, host)
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            if sys.platform == "win32":
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_EXCLUSIVEADDRUSE, 1)
            else:  # connections of an experiment before this one may linger
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            if CAN_HOLD:
                _hold(probe)
    except OSError as error:
        return error.errno not in (errno.EADDRINUSE, errno.EACCES)
    return True


def _is_free(host: str, port: int) -> bool:
    """Return whether nobody has bound it; if so it is held from now on, where that can be."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
        if CAN_HOLD:
            _hold(probe)
    return True


def _hold(bound: socket.socket) -> None:
    # bound as the only one, and shared only then, with whoever asks for a shared one and listens: our children do
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    _held.append(bound.detach())
    if len(_held) > _MOST_HELD:
        os.close(_held.popleft())
