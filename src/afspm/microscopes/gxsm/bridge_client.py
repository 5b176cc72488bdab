"""The link to GXSM by way of the script in its console (`bridge.py`): a secret, and then lines of JSON, over TCP."""

from __future__ import annotations

import base64
import json
import math
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from afspm.microscopes.gxsm.errors import BadReply, GxsmError
from afspm.translator.driver import ControllerLost

_LONGEST: Final = 1 << 29
_AT_ONCE: Final = 1 << 18
_TYPES: Final = {f"<{kind}" for kind in ("f8", "f4", "i8", "i4", "u8", "u4", "i2", "u2")} | {"|u1", "|i1"}
_SECRET: Final = "~/.afspm/gxsm-bridge-secret"
_WELCOME: Final = {"value": "afspm bridge"}
_HINT: Final = "is bridge.py running in GXSM's console? Nothing is answered while a call of it blocks"


class BridgeLink:
    """A connection to the bridge. Whatever goes wrong on it but an error that it tells of, it is closed: a late answer
    must never be taken for that to the next call.

    Args:
        timeout_s: how long an answer may take, in real time.
        monotonic_s: real time.
        secret_file: left out: where the bridge of this user puts it.

    Raises:
        ControllerLost: nobody listens there.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        secret_file: Path | None = None,
    ) -> None:
        self._timeout_s = timeout_s
        self._monotonic_s = monotonic_s
        self._where = f"{address[0]}:{address[1]}"
        try:
            self._socket = socket.create_connection(address, timeout_s)
        except OSError as error:
            raise ControllerLost(f"no connection: {error}", where=self._where, hint=_HINT) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._secret_file = secret_file or Path(_SECRET).expanduser()
        self._is_welcome = False

    def _introduce(self) -> None:
        """Send the secret, before the first call. Raises ControllerLost: there is none, or not what the bridge has."""
        secret_file = self._secret_file
        hint = f"run the bridge.py of this version, and use its ~/.afspm/{secret_file.name} (secret_file)"
        try:
            if os.name == "posix" and secret_file.stat().st_mode & 0o077:
                raise ControllerLost("others can read the bridge's secret", where=str(secret_file), hint="chmod 600")
            reply = self._replied("the secret", secret_file.read_bytes().strip() + b"\n")
        except OSError as error:
            self.close()
            raise ControllerLost(f"the bridge's secret can't be read: {error}", hint=hint) from error
        except ControllerLost as error:
            self.close()
            raise ControllerLost(f"the bridge did not welcome us: {error}", where=self._where, hint=hint) from error
        if reply != _WELCOME:
            self.close()
            raise ControllerLost("is not the bridge of this version of afspm", where=self._where, hint=hint)
        self._is_welcome = True

    def call(self, method: str, *arguments: str | int | float) -> Any:
        """Call a function of GXSM (see `Link`)."""
        if not self._is_welcome:
            self._introduce()
        reply = self._replied(method, _message(method, *arguments))
        if "error" in reply:
            raise GxsmError(str(reply["error"]), where=method)
        return reply["value"]

    def working_folder(self) -> Path | None:
        """Return where GXSM was started; it saves there until its user chooses another folder."""
        return Path(str(self.call("getcwd")))

    def _replied(self, method: str, message: bytes) -> dict[str, Any]:
        """Return the reply to a message. Raises ControllerLost: none, or what is none; the link is closed."""
        try:
            return _reply(self._exchange(method, message))
        except TimeoutError as error:
            self.close()
            what = f"no answer to {method} within {self._timeout_s:g} s"
            raise ControllerLost(what, where=self._where, hint=_HINT) from error
        except OSError as error:
            self.close()
            what = f"the connection was lost at {method}: {error}"
            raise ControllerLost(what, where=self._where, hint=_HINT) from error
        except ControllerLost:
            self.close()
            raise

    def close(self) -> None:
        """End the connection."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _exchange(self, method: str, message: bytes) -> bytes:
        """The line that is replied."""
        until_s = self._monotonic_s() + self._timeout_s
        self._socket.settimeout(self._timeout_s)
        self._socket.sendall(message)
        parts: list[bytes] = []
        size = 0
        while not (parts and parts[-1].endswith(b"\n")):
            left_s = until_s - self._monotonic_s()
            if left_s <= 0.0:
                raise TimeoutError
            self._socket.settimeout(left_s)
            part = self._socket.recv(_AT_ONCE)
            if not part:
                what = f"the connection was closed after {size} bytes of the reply to {method}"
                raise ControllerLost(what, where=self._where, hint=_HINT)
            parts.append(part)
            size += len(part)
            if size > _LONGEST or b"\n" in part[:-1]:
                raise BadReply(f"more than one answer to {method}", where=self._where)
        return b"".join(parts)


@lru_cache(256, typed=True)  # the same few are asked again and again, a frame by seven questions
def _message(method: str, *arguments: str | int | float) -> bytes:
    return json.dumps([method, *arguments]).encode() + b"\n"


def _reply(line: bytes) -> dict[str, Any]:
    try:
        reply = _REPLY.decode(line.decode())
    except (ValueError, RecursionError) as error:
        raise BadReply(f"the bridge replied what is none: {error}") from error
    if not isinstance(reply, dict) or len(reply) != 1 or not reply.keys() <= {"value", "error"}:
        raise BadReply(f"the bridge replied {line[:100]!r}")
    return reply


def _unpacked(found: dict[str, Any]) -> Any:
    if found.keys() != {"array", "shape", "bytes"}:
        return found
    kind, shape = found["array"], found["shape"]
    if kind not in _TYPES or not isinstance(shape, list) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise BadReply(f"the bridge replied an array of {kind!r} and shape {shape!r:.100}")
    content = base64.b64decode(str(found["bytes"]), validate=True)
    if len(content) != math.prod(shape) * np.dtype(kind).itemsize:
        raise BadReply(f"the bridge replied {len(content)} bytes for an array of shape {shape!r:.100}")
    return np.frombuffer(content, kind).reshape(shape)


_REPLY: Final = json.JSONDecoder(object_hook=_unpacked)
