"""Restricted unpickler for Gxsm4's results: numbers, texts, bytes, containers and numpy arrays of numbers.

No name in a pickle is imported, and only the stand-ins for numpy's types below are called. The base class is the
standard library's unpickler in pure Python: the faster version in C allocates as much memory as a damaged pickle
announces.
"""

from __future__ import annotations

import io
import pickle
from typing import Any, Final

import numpy as np

from afspm.plugins.gxsm.errors import BadReply

_NUMBERS: Final = {f"{kind}{size}" for kind in "fiu" for size in (1, 2, 4, 8)} - {"f1", "f2"}
_MOST_PARTS: Final = 1_000_000


class _DType:
    """Stand-in for numpy's dtype of plain numbers."""

    def __init__(self, code: object, *_: object) -> None:
        if code not in _NUMBERS:
            raise BadReply(f"an array of {code!r}")
        self.numpy = np.dtype(str(code))

    def __setstate__(self, state: Any) -> None:
        self.numpy = self.numpy.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """Stand-in for numpy's array, filled from (version, shape, type, True for column-major, bytes)."""

    values: np.ndarray | None = None

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, by_columns, content = state
        self.values = _array(content, kind, shape, "F" if by_columns else "C")


def _array(content: object, kind: object, shape: Any, order: object) -> np.ndarray:
    if not (isinstance(kind, _DType) and isinstance(content, bytes | bytearray) and order in ("C", "F")):
        raise BadReply("a malformed array")
    return np.frombuffer(bytes(content), kind.numpy).reshape(tuple(shape), order=order)


def _from_buffer(content: object, kind: object, shape: object, order: object) -> _Array:
    made = _Array()
    made.values = _array(content, kind, shape, order)
    return made


def _scalar(kind: object, content: object) -> object:
    return _array(content, kind, (), "C").item()


_ALLOWED: Final[dict[tuple[str, str], object]] = {("numpy", "dtype"): _DType, ("numpy", "ndarray"): _Array}
for _core in ("numpy.core", "numpy._core"):  # names before and since numpy 2
    _ALLOWED[f"{_core}.multiarray", "_reconstruct"] = lambda *_: _Array()
    _ALLOWED[f"{_core}.multiarray", "scalar"] = _scalar
    _ALLOWED[f"{_core}.numeric", "_frombuffer"] = _from_buffer


class _Unpickler(pickle._Unpickler):  # type: ignore[name-defined, misc, unused-ignore]
    def find_class(self, module: str, name: str) -> object:
        if (module, name) not in _ALLOWED:
            raise BadReply(f"GXSM's reply refers to {f'{module} {name}'[:100]!r}, which afspm does not run")
        return _ALLOWED[module, name]


def loads(content: bytes) -> object:
    """Return the value of a pickle.

    Raises:
        BadReply: the pickle is malformed or too large, or has a type that GXSM does not send.
    """
    try:
        return _Values().of(_Unpickler(io.BytesIO(content), encoding="latin-1").load())
    except BadReply:
        raise
    except RecursionError:
        raise BadReply("GXSM's reply is nested too deeply") from None
    except Exception as error:  # damaged bytes make the unpickler raise almost any error
        raise BadReply(f"GXSM's reply is not a pickle of a value: {type(error).__name__}: {error}") from error


class _Values:
    """A converter of stand-ins to arrays, with a limit on parts: a list may contain itself."""

    def __init__(self) -> None:
        self._left = _MOST_PARTS

    def of(self, value: object) -> object:
        self._left -= 1
        if self._left < 0:
            raise BadReply("GXSM's reply has too many parts")
        if isinstance(value, _Array) and value.values is not None:
            return value.values
        if isinstance(value, tuple | list):
            return type(value)(self.of(part) for part in value)
        if isinstance(value, dict) and all(isinstance(key, str | int | float) for key in value):
            return {key: self.of(part) for key, part in value.items()}
        if value is None or isinstance(value, bool | int | float | str | bytes):
            return value
        raise BadReply(f"GXSM's reply holds no value: {type(value).__name__}")
