"""The connections to Nanosurf Studio: one for short questions, one for each command that takes its time."""

from __future__ import annotations

import struct
from collections.abc import Callable
from concurrent.futures import Future
from threading import Thread
from typing import Any, Final

from afspm.errors import AfspmError
from afspm.microscopes.nanosurf.lua_values import BadLua, parse
from afspm.translator.driver import ControllerLost
from afspm.translator.tcp import Receiver, TcpConnection, host_and_port

_LENGTH: Final = struct.Struct("<I")
_LONGEST_REPLY: Final = 1 << 28
_HOURS_S: Final = 24 * 3600.0
_SHOWN: Final = 60
_HINTS: Final = (
    "does Nanosurf Studio run, with its scripting interface licensed and switched on?",
    "a dialog may wait on its screen",
)


class StudioError(AfspmError):
    """Studio could not run a script: its own words."""

    code = "nanosurf-error"


class Link:
    """One connection. Raises ControllerLost: nobody listens there. ConfigError: it is no address."""

    def __init__(self, address: str, timeout_s: float, monotonic_s: Callable[[], float]) -> None:
        self._connection = TcpConnection(host_and_port(address), timeout_s, monotonic_s, _HINTS)

    def run(self, script: str) -> list[Any]:
        """Run a script, and return the values that it returns.

        Raises:
            StudioError: it failed. ControllerLost: no reply, or none to be trusted; the connection is closed.
        """
        self.send(script)
        return self.receive(script)

    def send(self, script: str) -> None:
        """Send a script, whose values are to be received before the next is sent. Raises ControllerLost."""
        raw = script.encode()
        self._connection.send(_shown(script), _LENGTH.pack(len(raw)) + raw)

    def receive(self, script: str, *, longer_s: float = 0.0) -> list[Any]:
        """Return the values of a script that was sent. Raises as `run` does."""
        status, content = self._connection.receive(_shown(script), _read, longer_s=longer_s)
        if status != 0:
            raise StudioError(str(content.get(1, "no reason given")))
        return [content.get(number) for number in range(1, max(content, default=0) + 1)]

    def close(self) -> None:
        self._connection.close()


class LongCall:
    """A script that runs until the instrument is done, on a connection of its own.

    Args:
        link: in which the session is selected; it is closed at the end.
        done: called, from its thread, when it has ended.

    Attributes:
        what: it does.
    """

    def __init__(self, what: str, link: Link, script: str, done: Callable[[], None]) -> None:
        self.what = what
        self._result: Future[list[Any]] = Future()
        self._link, self._script, self._done = link, script, done
        link.send(script)  # before anything else can happen to this process
        Thread(target=self._work, name=f"nanosurf {what}", daemon=True).start()

    @property
    def running(self) -> bool:
        return not self._result.done()

    def result(self) -> list[Any]:
        """Return what it returned, once it is done. Raises StudioError, ControllerLost."""
        return self._result.result()

    def close(self) -> None:
        """Wait for it no longer."""
        self._link.close()

    def _work(self) -> None:
        try:
            self._result.set_result(self._link.receive(self._script, longer_s=_HOURS_S))
        except Exception as error:
            self._result.set_exception(error)
        finally:
            self._link.close()
            self._done()


def _read(receiver: Receiver) -> tuple[Any, dict[Any, Any]]:
    """Read "{status,{values}}". Raises ControllerLost: it is something else."""
    (size,) = _LENGTH.unpack(receiver.exactly(_LENGTH.size))
    if size > _LONGEST_REPLY:
        raise ControllerLost(f"a reply of {size} bytes was announced")
    text = bytes(receiver.exactly(size)).decode("utf-8", "replace")
    try:
        reply = parse(text)
    except BadLua as error:
        raise ControllerLost(f"a reply that is not Lua: {error}") from error
    if not (isinstance(reply, dict) and reply.get(1) in (0, 1) and isinstance(reply.get(2), dict)):
        raise ControllerLost(f"a reply without a status: {text[:60]!r}")
    return reply[1], reply[2]


def _shown(script: str) -> str:
    """Return the beginning of a script, for messages."""
    first = " ".join(script.split())
    return first if len(first) <= _SHOWN else f"{first[:_SHOWN]}…"
