"""Link to GXSM through the script in its console (`bridge.py`): a handshake, then lines of JSON over TCP."""

from __future__ import annotations

import base64
import hmac
import json
import math
import os
import secrets
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from afspm.driver import ControllerLost, Receiver, TcpConnection
from afspm.plugins.gxsm.bridge import NONCE, SECRET, WELCOME, proof
from afspm.plugins.gxsm.errors import BadReply, GxsmError

_LONGEST: Final = 1 << 29
_TYPES: Final = {f"<{kind}" for kind in ("f8", "f4", "i8", "i4", "u8", "u4", "i2", "u2")} | {"|u1", "|i1"}
_HINT: Final = "is bridge.py running in GXSM's console? Nothing is answered while a call of it blocks"


class _NoRoom(ControllerLost):
    """The error that the bridge serves as many clients as it can; its message says what to do."""


class BridgeLink:
    """A connection to the bridge; the first call performs the handshake. For other arguments, see `TcpConnection`.

    Args:
        secret_file: copy of the bridge's secret. Default: the bridge's own file in this user's home.
    """

    def __init__(
        self,
        address: tuple[str, int],
        timeout_s: float,
        monotonic_s: Callable[[], float],
        secret_file: Path | None = None,
    ) -> None:
        self._tcp = TcpConnection(address, timeout_s, monotonic_s, (_HINT, _HINT))
        self._secret_file = secret_file or Path(SECRET).expanduser()
        self._is_welcome = False
        self.close = self._tcp.close

    def call(self, method: str, *arguments: str | int | float) -> object:
        if not self._is_welcome:
            self._introduce()
        reply = self._tcp.ask(method, message(method, *arguments), _read)
        if "error" in reply:
            raise GxsmError(str(reply["error"]), where=method)
        return reply["value"]

    def working_folder(self) -> Path | None:
        """Return the folder in which GXSM was started: the folder of its files until the user changes it."""
        return Path(str(self.call("getcwd")))

    def _introduce(self) -> None:
        # Both sides prove that they know the secret without sending it, so that a program that listens at the bridge's
        # port in its place neither learns the secret nor receives calls.
        known, nonce = self._secret(), secrets.token_hex(NONCE // 2)
        try:
            answer = self._step("challenge", nonce)
            if not (isinstance(answer, list) and len(answer) == 2 and all(isinstance(one, str) for one in answer)):
                raise BadReply("the bridge is of another version of afspm")
            nonces, address = (nonce, answer[0]), self._tcp.peer
            if not hmac.compare_digest(
                answer[1].encode("utf-8", "replace"), proof(known, "bridge", address, *nonces).encode()
            ):
                raise ControllerLost("the program that listens there does not know the bridge's secret")
            if self._step("response", proof(known, "client", address, *nonces)) != WELCOME:
                raise BadReply("the bridge is of another version of afspm")
        except ControllerLost as error:
            self.close()
            hint = (
                f"run the bridge.py of this version, and use its {SECRET} (secret_file); a tunnel needs the bridge's "
                "port number at both ends"
            )
            if isinstance(error, _NoRoom):
                hint = ""
            raise ControllerLost(f"no connection to the bridge: {error}", where=self._tcp.where, hint=hint) from error
        self._is_welcome = True

    def _step(self, step: str, text: str) -> object:
        reply = self._tcp.ask(f"the {step}", json.dumps([step, text]).encode() + b"\n", _read, is_secret=True)
        if "error" in reply:
            # to a wrong response the bridge disconnects: an error means that secret and version are right
            raise (_NoRoom if step == "response" else ControllerLost)(str(reply["error"]))
        return reply["value"]

    def _secret(self) -> bytes:
        file = self._secret_file
        try:
            if os.name == "posix" and file.stat().st_mode & 0o077:
                self.close()
                raise ControllerLost("other users can read the bridge's secret", where=str(file), hint="chmod 600")
            return file.read_bytes().strip()
        except OSError as error:
            self.close()
            hint = f"run bridge.py once, or give a copy of its {SECRET} as secret_file"
            raise ControllerLost(f"the bridge's secret can't be read: {error}", hint=hint) from error


def _read(receiver: Receiver) -> dict[str, object]:
    # More bytes after the line: the answer to an earlier call, or a second answer. The connection is out of step.
    parts = [receiver.some()]
    size = len(parts[0])
    while not parts[-1].endswith(b"\n"):
        if size > _LONGEST or b"\n" in parts[-1]:
            break
        parts.append(receiver.some())
        size += len(parts[-1])
    if size > _LONGEST or b"\n" in parts[-1][:-1]:
        raise BadReply("the bridge answered a call more than once")
    return _reply(b"".join(parts))


@lru_cache(256, typed=True)  # few different calls, often repeated: reading the frame takes seven
def message(method: str, *arguments: str | int | float) -> bytes:
    """Encode the call of a function as a line of JSON."""
    return json.dumps([method, *arguments]).encode() + b"\n"


def value_line(value: object) -> bytes:
    """Encode a value as the bridge sends it."""
    return json.dumps({"value": value}, default=_packed).encode() + b"\n"


def value_of(line: bytes) -> object:
    """Return the value in the bridge's reply. Raises BadReply: a malformed line; KeyError: an error, not a value."""
    return _reply(line)["value"]


def _packed(value: object) -> object:
    if isinstance(value, np.ndarray):
        shown = base64.b64encode(value.tobytes()).decode()
        return {"array": value.dtype.str, "shape": value.shape, "bytes": shown}
    return value.item() if isinstance(value, np.generic) else str(value)


def _reply(line: bytes) -> dict[str, object]:
    try:
        reply = _REPLY.decode(line.decode())
    except (ValueError, RecursionError) as error:
        raise BadReply(f"the bridge sent an unreadable reply: {error}") from error
    if not isinstance(reply, dict) or len(reply) != 1 or not reply.keys() <= {"value", "error"}:
        raise BadReply(f"the bridge replied {line[:100]!r}")
    return reply


def _unpacked(found: dict[str, object]) -> object:
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
