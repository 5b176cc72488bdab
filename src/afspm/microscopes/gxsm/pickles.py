"""What Gxsm4 pickles, read without unpickling: nothing is imported, nothing called, whatever the bytes say.

A pickle is a program for a small stack machine (documented in the standard library's `pickletools`). Here it may make
numbers, texts, bytes, tuples, lists, dicts and numpy arrays of numbers; anything else is refused.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from afspm.microscopes.gxsm.errors import BadReply

_PLAIN: Final = {
    "BININT": int, "BININT1": int, "BININT2": int, "LONG1": int, "LONG4": int, "BINFLOAT": float,
    "SHORT_BINUNICODE": str, "BINUNICODE": str, "BINUNICODE8": str,
    "SHORT_BINBYTES": bytes, "BINBYTES": bytes, "BINBYTES8": bytes, "BYTEARRAY8": bytes,
}  # fmt: skip
_CONSTANTS: Final = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_SMALL_TUPLES: Final = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_GETS, _PUTS = {"BINGET", "LONG_BINGET"}, {"BINPUT", "LONG_BINPUT"}
_NUMBERS: Final = {f"{kind}{size}" for kind in "fiu" for size in (1, 2, 4, 8)} - {"f1", "f2"}
_MARK: Final = object()
_PARTS: Final = 1_000_000


class _Type:
    """numpy's dtype of plain numbers."""

    def __init__(self, code: object) -> None:
        if code not in _NUMBERS:
            raise BadReply(f"an array of {code!r}")
        self.numpy = np.dtype(str(code))

    def fill(self, state: Any) -> None:
        """Its byte order."""
        self.numpy = self.numpy.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """numpy's array, to be filled."""

    values: np.ndarray | None = None

    def fill(self, state: Any) -> None:
        """With (version, shape, type, whether by columns, bytes)."""
        _, shape, kind, by_columns, content = state
        self.values = _array(content, kind, shape, "F" if by_columns else "C")


def _array(content: Any, kind: Any, shape: Any, order: Any) -> np.ndarray:
    if not (isinstance(kind, _Type) and isinstance(content, bytes) and order in ("C", "F")):
        raise BadReply("an array that is none")
    return np.frombuffer(content, kind.numpy).reshape(tuple(shape), order=order)


def _from_buffer(content: Any, kind: Any, shape: Any, order: Any) -> _Array:
    made = _Array()
    made.values = _array(content, kind, shape, order)
    return made


_CORES: Final = ("numpy.core", "numpy._core")  # before numpy 2, and since
_CALLS: Final[dict[str, Callable[..., Any]]] = {
    "numpy dtype": lambda code, *_: _Type(code),
    **{f"{core}.multiarray _reconstruct": lambda *_: _Array() for core in _CORES},
    **{f"{core}.multiarray scalar": lambda kind, content: _array(content, kind, (), "C").item() for core in _CORES},
    **{f"{core}.numeric _frombuffer": _from_buffer for core in _CORES},
}
_CLASSES: Final[dict[str, object]] = {**_CALLS, "numpy ndarray": object()}


def loads(content: bytes) -> Any:
    """The value of a pickle.

    Raises:
        BadReply: it is none, or of something that GXSM does not reply.
    """
    try:
        return _Finishing().value(_Machine().run(content))
    except BadReply:
        raise
    except RecursionError:
        raise BadReply("GXSM's reply is nested too deeply") from None
    except Exception as error:  # whatever the bytes make of the machine
        raise BadReply(f"GXSM's reply is no pickle of a value: {type(error).__name__}: {error}") from error


class _Machine:
    """The stack, and what was put aside."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._memo: dict[int, Any] = {}

    def run(self, content: bytes) -> Any:
        for opcode, argument, _ in pickletools.genops(content):
            if opcode.name == "STOP":
                if len(self._stack) != 1:
                    raise BadReply(f"a pickle that leaves {len(self._stack)} values")
                return self._stack.pop()
            self._step(opcode.name, argument)
        raise BadReply("a pickle without an end")

    def _step(self, name: str, argument: Any) -> None:
        stack = self._stack
        if name in _PLAIN:
            stack.append(_PLAIN[name](argument))
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _SMALL_TUPLES:
            stack.append(tuple(self._popped(_SMALL_TUPLES[name])))
        elif name in ("MEMOIZE", *_PUTS):
            self._memo[len(self._memo) if argument is None else argument] = stack[-1]
        elif name in _GETS:
            stack.append(self._memo[argument])
        elif name in ("GLOBAL", "STACK_GLOBAL"):
            stack.append(self._named(argument if name == "GLOBAL" else " ".join(map(str, self._popped(2)))))
        elif name not in ("PROTO", "FRAME"):
            self._build(name)

    def _build(self, name: str) -> None:
        stack = self._stack
        if name == "MARK":
            stack.append(_MARK)
        elif name == "TUPLE":
            stack.append(tuple(self._popped_to_mark()))
        elif name in ("EMPTY_LIST", "EMPTY_DICT"):
            stack.append([] if name == "EMPTY_LIST" else {})
        elif name in ("APPEND", "APPENDS"):
            values = self._popped(1) if name == "APPEND" else self._popped_to_mark()
            self._top(list).extend(values)
        elif name in ("SETITEM", "SETITEMS"):
            values = self._popped(2) if name == "SETITEM" else self._popped_to_mark()
            self._top(dict).update(zip(values[::2], values[1::2], strict=True))
        elif name == "REDUCE":
            call, arguments = self._popped(2)
            stack.append(call(*arguments) if call in _CALLS.values() else self._named(call))
        elif name == "BUILD":
            (state,) = self._popped(1)
            self._top(_Type if isinstance(stack[-1], _Type) else _Array).fill(state)
        else:
            raise BadReply(f"GXSM's reply does what no value needs: {name}")

    def _named(self, name: object) -> Any:
        if name not in _CLASSES:
            raise BadReply(f"GXSM's reply asks for {str(name)[:100]!r}, which is not run")
        return _CLASSES[str(name)]

    def _top(self, kind: type) -> Any:
        if not isinstance(self._stack[-1], kind):
            raise BadReply(f"a pickle that fills a {type(self._stack[-1]).__name__}")
        return self._stack[-1]

    def _popped(self, count: int) -> list[Any]:
        if len(self._stack) < count:
            raise BadReply("a pickle that takes what is not there")
        values = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return values

    def _popped_to_mark(self) -> list[Any]:
        at = max(i for i, value in enumerate(self._stack) if value is _MARK)
        values = self._stack[at + 1 :]
        del self._stack[at:]
        return values


class _Finishing:
    """Puts arrays in place of what they were made from; it ends also where a list holds itself, or many times the
    same."""

    def __init__(self) -> None:
        self._left = _PARTS

    def value(self, value: Any) -> Any:
        self._left -= 1
        if self._left < 0:
            raise BadReply("GXSM's reply has too many parts")
        if isinstance(value, _Array):
            if value.values is None:
                raise BadReply("an array without values")
            return value.values
        if isinstance(value, tuple | list):
            return type(value)(self.value(part) for part in value)
        if isinstance(value, dict):
            return {_hashable(key): self.value(part) for key, part in value.items()}
        if value is not None and not isinstance(value, bool | int | float | str | bytes):
            raise BadReply("GXSM's reply holds no value")
        return value


def _hashable(key: Any) -> Any:
    if not isinstance(key, str | int | float):
        raise BadReply(f"a dict with the key {key!r}")
    return key
