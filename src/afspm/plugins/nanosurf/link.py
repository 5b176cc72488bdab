"""Connections to Nanosurf Studio: one for quick scripts, one for each long command.

The maker's own client is no dependency: it waits for replies without a limit, takes a lost connection for a slow one,
and writes Python files into its own folder.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final

from afspm.basics import AfspmError
from afspm.driver import ControllerLost, Receiver, TcpConnection, host_and_port
from afspm.plugins.nanosurf.lua_values import BadLua, parse

# Length of a script or reply in bytes, least significant byte first.
_LENGTH: Final = struct.Struct("<I")
_LONGEST_REPLY: Final = 1 << 28
_SHOWN: Final = 60
_HINTS: Final = (
    "does Nanosurf Studio run, with its scripting interface licensed and switched on?",
    "a dialog may wait on its screen",
)


class StudioError(AfspmError):
    """An error of a script, reported by Studio with its own text."""

    code = "nanosurf-error"


class Link:
    """A connection to Studio.

    Raises:
        ControllerLost: the port does not accept connections. ConfigError: the address is malformed.
    """

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._connection = TcpConnection(host_and_port(address), timeout_s, monotonic_s, _HINTS)

    def run(self, script: str) -> list[Any]:
        """Run a script and return its values.

        Raises:
            StudioError: the script failed.
            ControllerLost: no reply, or a malformed reply; the connection is closed.
        """
        self.begin(script)
        return self._values(shown(script))

    def begin(self, script: str) -> None:
        """Start a script; its `reply` must be received before the next script. Raises ControllerLost."""
        raw = script.encode()
        # Studio executes one script at a time on a connection, and replies at its end.
        self._connection.send(shown(script), _LENGTH.pack(len(raw)) + raw)

    def wait(self, within_s: float) -> None:
        """Wait for the reply to `begin`, at most `within_s` of real time."""
        self._connection.has_answer(within_s)

    def reply(self, what: str) -> tuple[bool, list[Any]]:
        """Return whether the reply has arrived, and its values (empty until then). Raises the errors of `run`."""
        return (True, self._values(what)) if self._connection.has_answer() else (False, [])

    def _values(self, what: str) -> list[Any]:
        status, content = self._connection.receive(what, _read)
        if status != 0:
            raise StudioError(str(content.get(1, "no reason given")))
        return [content.get(number) for number in range(1, max(content, default=0) + 1)]

    def close(self) -> None:
        self._connection.close()


def _read(receiver: Receiver) -> tuple[Any, dict[Any, Any]]:
    (size,) = _LENGTH.unpack(receiver.exactly(_LENGTH.size))
    if size > _LONGEST_REPLY:
        raise ControllerLost(f"a reply of {size} bytes was announced")
    text = bytes(receiver.exactly(size)).decode("utf-8", "replace")
    try:
        reply = parse(text)
    except BadLua as error:
        raise ControllerLost(f"a reply that is not Lua: {error}") from error
    # {0,{values…}} after success, {1,{text}} after an error.
    if not (isinstance(reply, dict) and reply.get(1) in (0, 1) and isinstance(reply.get(2), dict)):
        raise ControllerLost(f"a reply without a status: {text[:60]!r}")
    return reply[1], reply[2]


def shown(script: str) -> str:
    """Return the beginning of a script, for messages."""
    first = " ".join(script.split())
    return first if len(first) <= _SHOWN else f"{first[:_SHOWN]}…"
