"""Requests to ZeroMQ-XOP and its replies: calls of Igor functions as JSON, without input or output.

The forms follow the source and specification of ZeroMQ-XOP (byte physics and the Allen Institute), first version of the
interface.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from afspm.basics import AfspmError, InvalidValue, PlainMapping
from afspm.driver import ControllerLost

LONGEST_REQUEST: Final = 1024
"""Length of the longest request, in bytes. At a longer request the XOP drops the connection without a reply."""

MISSING: Final = 101
"""Error number for a function that Igor does not have."""

_MEANINGS: Final = {
    1: "an error without a name",
    3: "the request is not valid JSON",
    4: "another version of the interface",
    5: "the request names no function",
    6: "the request is malformed",
    7: "the request's messageID is malformed",
    8: "Igor is out of memory",
    100: "Igor's procedures are not compiled",
    101: "there is no such function",
    102: "too few arguments",
    103: "too many arguments",
    104: "an argument is of a type that can't be passed",
    105: "the result is of a type that can't be passed",
    106: "an argument has an invalid value",
    107: "the function was aborted",
}
_HINTS: Final = {
    100: "a procedure window was edited: compile the procedures",
    101: "is afspm.ipf included in Igor's procedures (see the README of plugins/asylum)?",
}

Parameter = bool | int | float | str


class XopError(AfspmError):
    """An error reported by Igor.

    Attributes:
        number: error number of ZeroMQ-XOP.
    """

    code = "igor-error"

    def __init__(self, number: int, message: str, *, where: str = "") -> None:
        meaning = _MEANINGS.get(number, "an unknown error")
        super().__init__(f"{meaning} ({number}: {message})", where=where, hint=_HINTS.get(number, ""))
        self.number = number


class BadReply(ControllerLost):
    """The error that a reply is malformed or has an unexpected result: the peer can't be trusted."""

    code = "igor-bad-reply"


Result = float | str | None
"""The result of an Igor function. None: a wave, which no function used here returns."""


@dataclass(frozen=True)
class Reply:
    """A parsed reply of ZeroMQ-XOP.

    Attributes:
        message_id: id of the request; None if the reply has no id, as for a request that the XOP could not read.
        error: number and message of an error; None: success.
        results: the results of the function; empty after an error.
    """

    message_id: str | None
    error: tuple[int, str] | None = None
    results: tuple[Result, ...] = ()


def request(name: str, parameters: Sequence[Parameter], message_id: str) -> bytes:
    """Encode the call of a function.

    Raises:
        InvalidValue: the request is longer than 1024 bytes, a number is not finite, or a text is not Unicode.
    """
    for value in parameters:
        if isinstance(value, float) and not math.isfinite(value):
            raise InvalidValue(f"{name} can't be called with {value}")
    call = {"name": name, "params": list(parameters)} if parameters else {"name": name}
    # the XOP accepts the integer 1 only; its own readme has "v1" by mistake
    content = {"version": 1, "messageID": message_id, "CallFunction": call}
    try:
        message = json.dumps(content, ensure_ascii=False, separators=(",", ":")).encode()
    except UnicodeEncodeError as error:
        raise InvalidValue(f"{name} can't be called with a text that is not Unicode") from error
    if len(message) > LONGEST_REQUEST:
        raise InvalidValue(f"the call of {name} has {len(message)} bytes; ZeroMQ-XOP takes at most {LONGEST_REQUEST}")
    return message


def reply(message: bytes) -> Reply:
    """Parse a reply. Raises BadReply: the reply is malformed."""
    try:
        return _reply(json.loads(message.decode("utf-8")))
    except BadReply:
        raise
    except RecursionError as error:
        raise BadReply("ZeroMQ-XOP sent JSON that is nested too deeply") from error
    except (ValueError, TypeError, KeyError, OverflowError, AttributeError) as error:
        shown = message[:80].decode("utf-8", "replace")
        raise BadReply(f"ZeroMQ-XOP sent an unreadable reply, {shown!r}: {error}") from error


def _reply(content: PlainMapping) -> Reply:
    message_id = content.get("messageID")
    number = content["errorCode"]["value"]
    if type(number) is not int or not isinstance(message_id, str | None):
        raise ValueError("errorCode or messageID has the wrong type")
    if number:
        history = str(content.get("history") or "").strip()
        message = str(content["errorCode"].get("msg", ""))
        return Reply(message_id, (number, f"{message} {history}".strip()))
    found = content.get("result", [])
    results = [_value(one) for one in (found if isinstance(found, list) else [found])]
    return Reply(message_id, None, tuple(results))


def _value(one: Mapping[str, object]) -> Result:
    kind, value = one["type"], one["value"]
    if kind == "variable":
        return _number(value)
    if kind in ("string", "dfref"):
        if not isinstance(value, str):
            raise ValueError(f"{value!r} is not a text")
        return value
    if kind == "wave":
        return None
    raise ValueError(f"a result of type {kind!r}")


def _number(value: object) -> float:
    # JSON has no NaN and no infinities: the XOP writes them as texts.
    if value in ("nan", "inf", "-inf") or (isinstance(value, int | float) and not isinstance(value, bool)):
        return float(value)
    raise ValueError(f"{value!r} is not a number")
