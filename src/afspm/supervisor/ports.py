"""Free ports for the addresses that an experiment file leaves open."""

from __future__ import annotations

import random
import socket

# Below the range from which systems take the ports of outgoing connections (Linux from 32768, Windows and macOS from
# 49152). From within it a port would be no choice: while its process is being restarted, a peer that tries again and
# again may be given that very port by its own system, connect to itself, and keep the process from ever binding it.
LOWEST, HIGHEST = 20_000, 32_000
TRIES = 200


class FreePorts:
    """Hands out ports of this computer that nobody listens on, each once.

    The port is chosen here and bound by the child, so that a restarted child is found where it was. Between the two
    another program may take it: the child then fails to bind and says so.
    """

    def __init__(self, host: str = "127.0.0.1") -> None:
        self._host = host
        self._given: set[int] = set()
        self._random = random.Random()

    def take(self) -> int:
        """A port that was free just now.

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
        """A free address for a socket, as ZeroMQ writes it."""
        return f"tcp://{self._host}:{self.take()}"


def _is_free(host: str, port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True
