"""ZeroMQ-XOP's side of its protocol: what a request asks for, and the bytes of a reply. Pure.

After the source and specification of ZeroMQ-XOP, interface version 1; written apart from the translator's, so that
each is a check of the other.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NoReturn

LONGEST_REQUEST: Final = 1024

MESSAGES: Final = {
    1: "Unknown error.",
    3: "The string is not a valid json object.",
    4: "Request interface version is missing or invalid.",
    5: "Request has no or an invalid operation.",
    6: "CallFunction: The operation has an invalid format.",
    7: "The messageID is invalid.",
    8: "Out of memory.",
    100: "Procedures are not compiled.",
    101: "CallFunction: Unknown function.",
    102: "CallFunction: Too few parameters.",
    103: "CallFunction: Too many parameters.",
    104: "CallFunction: Unsupported function signature.",
    105: "CallFunction: Unsupported function return type.",
    106: "CallFunction: Parameter has an invalid format.",
    107: "CallFunction: The function was aborted.",
}
_NUMBER: Final = re.compile(r"\s*[+-]?(\d+\.?\d*([eE][+-]?\d+)?|\.\d+([eE][+-]?\d+)?|inf|nan)?\s*", re.IGNORECASE)

Value = float | str | Mapping[str, Any] | None


class Failed(Exception):
    """A request that is answered with an error.

    Attributes:
        number: of ZeroMQ-XOP's errors.
        history: what Igor printed meanwhile.
    """

    def __init__(self, number: int, history: str = "") -> None:
        super().__init__(MESSAGES[number])
        self.number = number
        self.history = history


@dataclass(frozen=True)
class Call:
    """What a request asks for."""

    name: str
    parameters: tuple[str, ...]
    message_id: str | None


@dataclass(frozen=True)
class Function:
    """A function of Igor's.

    Attributes:
        do: it; gives its result, those of several as a tuple, and where something is passed by reference a tuple of
            that and of what becomes of the latter.
        takes: a letter for each parameter: v(ariable), s(tring), d(ata folder), in upper case by reference; anything
            else can't be passed.
        gives: a letter for each result: v, s, d, w(ave); anything else can't be passed.
    """

    do: Callable[..., Any]
    takes: str = ""
    gives: str = "v"


def call(payload: bytes) -> Call:
    """The call that a request makes.

    Raises:
        Failed: 3 to 7 or 106: the request itself is wrong.
    """
    try:
        content = json.loads(payload.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise Failed(3) from None
    if not isinstance(content, dict):
        raise Failed(3)
    version, message_id = content.get("version"), content.get("messageID")
    if type(version) is not int or version != 1:
        raise Failed(4)
    if "messageID" in content and not (isinstance(message_id, str) and 1 <= len(message_id.encode()) <= 255):
        raise Failed(7)
    wanted = content.get("CallFunction")
    if not isinstance(wanted, dict):
        raise Failed(5)
    if not (wanted.keys() in ({"name"}, {"name", "params"}) and isinstance(wanted["name"], str)):
        raise Failed(6)
    given = wanted.get("params", [])
    if not isinstance(given, list):
        raise Failed(106)
    return Call(wanted["name"], tuple(map(_parameter, given)), message_id)


def arguments(function: Function | None, parameters: Sequence[str]) -> list[float | str]:
    """What a function is called with.

    Raises:
        Failed: 101 to 106: it is not there, or can't be called so.
    """
    if function is None:
        raise Failed(101)
    if not set(function.takes.lower()) <= set("vsd"):
        raise Failed(104)
    if not set(function.gives) <= set("vsdw"):
        raise Failed(105)
    if len(parameters) != len(function.takes):
        raise Failed(102 if len(parameters) < len(function.takes) else 103)
    return [_argument(kind.lower(), text) for kind, text in zip(function.takes, parameters, strict=True)]


def success(function: Function, given_back: Any, message_id: str | None) -> bytes:
    """The reply with what a function gave.

    Raises:
        UnicodeEncodeError: a text that is not UTF-8: the real one swallows this, and never replies.
    """
    by_reference = [kind.lower() for kind in function.takes if kind.isupper()]
    results, passed = given_back if by_reference else (given_back, ())
    several = len(function.gives) > 1
    values = [_value(*one) for one in zip(function.gives, results if several else (results,), strict=True)]
    content: dict[str, Any] = {"errorCode": {"value": 0}, "result": values if several else values[0]}
    if by_reference:
        content["passByReference"] = [_value(*one) for one in zip(by_reference, passed, strict=True)]
    return _message(content, message_id)


def failure(failed: Failed, message_id: str | None) -> bytes:
    """The reply with an error."""
    content: dict[str, Any] = {"errorCode": {"value": failed.number, "msg": str(failed)}}
    if failed.history:
        content["history"] = failed.history
    return _message(content, message_id)


def wave(values: Sequence[float], **more: Any) -> dict[str, Any]:
    """A wave of one dimension as it is replied."""
    raw = [_variable(value) for value in values]
    return {
        "type": "NT_FP64",
        "date": {"modification": 0},
        "data": {"raw": raw},
        "dimension": {"size": [len(raw)]},
        **more,
    }


def _message(content: dict[str, Any], message_id: str | None) -> bytes:
    if message_id is not None:
        content["messageID"] = message_id
    return json.dumps(content, sort_keys=True, indent=4, ensure_ascii=False).encode("utf-8")


def _value(kind: str, value: Value) -> dict[str, Any]:
    types = {"v": "variable", "s": "string", "d": "dfref", "w": "wave"}
    return {"type": types[kind], "value": _variable(value) if isinstance(value, int | float) else value}


def _variable(value: float) -> Any:
    """As "%.15g" prints it: 3.0 is 3."""
    if not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    return json.loads(f"{value:.15g}")


def _parameter(given: Any) -> str:
    if isinstance(given, bool):
        return str(int(given))
    if isinstance(given, int | float):
        return f"{given:.15g}"
    if isinstance(given, str):
        return given
    raise Failed(106)


def _argument(kind: str, text: str) -> float | str:
    if kind != "v":
        return text
    if not _NUMBER.fullmatch(text):
        raise Failed(106)
    try:
        return float(text) if text.strip() else 0.0
    except ValueError:  # a sign alone
        raise Failed(106) from None


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
