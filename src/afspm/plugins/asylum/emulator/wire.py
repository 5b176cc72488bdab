"""Server side of the ZeroMQ-XOP protocol: decoding of requests and encoding of replies, without input or output.

The forms follow the source and specification of ZeroMQ-XOP, first version of the interface. The translator's code is
not used here: emulator and translator check each other.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NoReturn

from afspm.basics import Plain

LONGEST_REQUEST: Final = 1024

MESSAGES: Final = {
    1: "Unknown error in request interface.",
    3: "The string is not a valid json object.",
    4: "Request interface version is missing or invalid.",
    5: "Unknown operation type.",
    6: "Invalid operation format.",
    7: "Invalid optional messageID.",
    8: "Request cancelled due to Out Of Memory condition.",
    100: "Procedures are not compiled.",
    101: "CallFunction: Unknown function.",
    102: "CallFunction: Too few parameters.",
    103: "CallFunction: Too many parameters.",
    104: "CallFunction: Unsupported function signature.",
    105: "CallFunction: Unsupported function return type.",
    106: "CallFunction: Parameter is not an array or otherwise invalid.",
    107: "CallFunction: The function was partially executed but aborted at some point.",
}
_DECIMAL: Final = r"(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"
_HEXADECIMAL: Final = r"0x([0-9a-f]+\.?[0-9a-f]*|\.[0-9a-f]+)(p[+-]?\d+)?"
_NUMBER: Final = re.compile(
    rf"[ \t\n\v\f\r]*[+-]?({_HEXADECIMAL}|{_DECIMAL}|inf(inity)?|nan(\(\w*\))?)", re.IGNORECASE | re.ASCII
)
"""Numbers that C's strtod parses completely."""

Value = float | str | Mapping[str, object] | None


class CallFailed(Exception):
    """The error that is sent in answer to a request.

    Attributes:
        number: error number of ZeroMQ-XOP.
        history: text that Igor printed meanwhile.
    """

    def __init__(self, number: int, history: str = "") -> None:
        super().__init__(MESSAGES[number])
        self.number = number
        self.history = history


@dataclass(frozen=True)
class FunctionCall:
    """The function call of a request."""

    name: str
    parameters: tuple[str, ...]
    message_id: str | None


@dataclass(frozen=True)
class IgorFunction:
    """An Igor function.

    Attributes:
        do: implementation. Returns the result, a tuple for several results; with parameters by reference a tuple of the
            result and of the new values of these parameters.
        takes: a letter for each parameter: v(ariable), s(tring), d(ata folder), upper case by reference; any other type
            can't be passed.
        gives: a letter for each result: v, s, d, w(ave); any other type can't be passed.
        listed: True if declared with Igor's syntax for several results, which a function with one result may also use.
    """

    do: Callable[..., object]
    takes: str = ""
    gives: str = "v"
    listed: bool = False


def call(payload: bytes) -> FunctionCall:
    """Parse a request.

    Raises:
        CallFailed: 3 to 7 or 106: the request is malformed. 101: the name of the function is empty.
    """
    content = _parsed(payload)
    fields = content if isinstance(content, dict) else {}
    version, message_id = fields.get("version"), fields.get("messageID")
    if type(version) is not int or version != 1:
        raise CallFailed(4)
    if "messageID" in fields and not (isinstance(message_id, str) and 1 <= len(message_id.encode()) <= 255):
        raise CallFailed(7)
    wanted = fields.get("CallFunction")
    if not isinstance(wanted, dict):
        raise CallFailed(5)
    return FunctionCall(*_function_call(wanted), message_id)


def _parsed(payload: bytes) -> object:
    # Like the XOP's JSON library: a byte order mark is skipped, and the text ends at the first NUL.
    text = payload.removeprefix(b"\xef\xbb\xbf").partition(b"\0")[0]
    try:
        content = json.loads(text.decode("utf-8"), parse_constant=_no_constant, parse_int=_integer, parse_float=_finite)
        json.dumps(content, ensure_ascii=False).encode("utf-8")  # raises for lone surrogates
    except (ValueError, RecursionError):
        raise CallFailed(3) from None
    return content


def _function_call(wanted: Plain) -> tuple[str, tuple[str, ...]]:
    name, given = wanted.get("name"), wanted.get("params", [])
    if len(wanted) > 2 or not isinstance(name, str):
        raise CallFailed(6)
    if not name:
        raise CallFailed(101)
    if "params" not in wanted and len(wanted) > 1:
        raise CallFailed(6)
    if not isinstance(given, list):
        raise CallFailed(106)
    return name, tuple(map(_parameter, given))


def arguments(function: IgorFunction | None, parameters: Sequence[str]) -> list[float | str]:
    """Convert the parameters for a function.

    Raises:
        CallFailed: 101: unknown function. 102, 103, 106: wrong parameters. 104, 105: types that can't be passed.
    """
    if function is None:
        raise CallFailed(101)
    if len(parameters) != len(function.takes):
        raise CallFailed(102 if len(parameters) < len(function.takes) else 103)
    given = [_argument(kind.lower(), text) for kind, text in zip(function.takes, parameters, strict=True)]
    if not set(function.gives) <= set("vsdw"):
        raise CallFailed(105)
    if not set(function.takes.lower()) <= set("vsd"):
        raise CallFailed(104)
    return given


def success(function: IgorFunction, given_back: Any, message_id: str | None) -> bytes:
    """Encode the reply with a function's result.

    Raises:
        UnicodeEncodeError: a text in the result can't be encoded as UTF-8. The real XOP swallows this error and never
            replies.
    """
    by_reference = [kind.lower() for kind in function.takes if kind.isupper()]
    results, passed = given_back if by_reference else (given_back, ())
    several = function.listed or len(function.gives) > 1
    values = [_value(*one) for one in zip(function.gives, results if several else (results,), strict=True)]
    content: dict[str, object] = {"errorCode": {"value": 0}, "result": values if several else values[0]}
    if by_reference and not several:
        content["passByReference"] = [_value(*one) for one in zip(by_reference, passed, strict=True)]
    return _message(content, message_id)


def failure(failed: CallFailed, message_id: str | None) -> bytes:
    """Encode the reply with an error."""
    content: dict[str, object] = {"errorCode": {"value": failed.number, "msg": str(failed)}}
    if failed.history:
        content["history"] = failed.history
    return _message(content, message_id)


def wave(values: Sequence[float], **more: object) -> dict[str, object]:
    """Return a one-dimensional wave in its JSON form."""
    raw = [_variable(value) for value in values]
    return {
        "type": "NT_FP64",
        "date": {"modification": 0},
        "data": {"raw": raw},
        "dimension": {"size": [len(raw)]},
        **more,
    }


def _message(content: dict[str, object], message_id: str | None) -> bytes:
    if message_id is not None:
        content["messageID"] = message_id
    return json.dumps(content, sort_keys=True, indent=4, ensure_ascii=False).encode("utf-8")


def _value(kind: str, value: Value) -> dict[str, object]:
    types = {"v": "variable", "s": "string", "d": "dfref", "w": "wave"}
    return {"type": types[kind], "value": _variable(value) if isinstance(value, int | float) else value}


def _variable(value: float) -> object:
    # "%.15g": 3.0 arrives as the JSON integer 3. NaN and infinities are texts, since JSON has no such numbers.
    if not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    return json.loads(f"{value:.15g}")


def _parameter(given: object) -> str:
    if isinstance(given, bool):
        return str(int(given))
    if isinstance(given, int | float):
        return f"{float(given):.15g}"
    if isinstance(given, str):
        return given
    raise CallFailed(106)


def _argument(kind: str, text: str) -> float | str:
    if kind != "v":
        return text
    if not text:
        return 0.0
    if not _NUMBER.fullmatch(text):
        raise CallFailed(106)
    number = text.strip().lower()
    if "nan" in number:
        return math.nan
    return _from_hexadecimal(number) if "0x" in number else float(number)


def _from_hexadecimal(number: str) -> float:
    try:
        return float.fromhex(number)
    except OverflowError:
        return -math.inf if number.startswith("-") else math.inf


def _finite(text: str) -> float:
    # A number beyond the range of a double is malformed JSON to the XOP.
    number = float(text)
    if math.isinf(number):
        raise ValueError(f"{text} is out of range")
    return number


def _integer(text: str) -> int | float:
    # More than 64 bits: read as a double.
    is_short = len(text) <= 20 and -(2**63) <= int(text) < 2**64
    return int(text) if is_short else _finite(text)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
