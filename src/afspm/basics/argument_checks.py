"""Checks of arguments where people's programs call afspm, before anything is sent or read.

Without these, a wrong type fails far inside, as a bare TypeError of the wire format or of a path.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Final, ParamSpec, TypeGuard, TypeVar

from afspm.basics.errors import InvalidValue

P = ParamSpec("P")
R = TypeVar("R")
_MOST: Final = 2**63
"""Whole numbers on the wire are below this."""


@dataclass(frozen=True)
class Argument:
    """A kind of argument.

    Attributes:
        what: the kind in words, such as "a number".
        fits: returns whether a value is of this kind.
        hint: an example.
    """

    what: str
    fits: Callable[[object], bool]
    hint: str = ""


def plain(value: Any) -> Any:
    """Return Python's own number for a number of numpy or xarray, perhaps an array without dimensions."""
    return value.item() if getattr(value, "shape", None) == () else value


def is_text(value: object) -> TypeGuard[str]:
    """Return whether a value is text that can be sent."""
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a number that a float can hold, perhaps infinite, but not NaN."""
    value = plain(value)
    if isinstance(value, bool) or not isinstance(value, Real):
        return False
    try:
        return not math.isnan(float(value))
    except OverflowError:
        return False


TEXT: Final = Argument("text", is_text)
NAME: Final = Argument("a name as text", lambda value: is_text(value) and value != "", 'e.g. "scan-speed"')
NUMBER: Final = Argument("a number", is_number)
FINITE: Final = Argument("a finite number", lambda value: is_number(value) and math.isfinite(value))
SECONDS: Final = Argument("a number of seconds", is_number, "e.g. 60.0")
WHOLE: Final = Argument(
    "a whole number, zero or more",
    lambda value: isinstance(value, Integral) and not isinstance(value, bool) and 0 <= int(value) < _MOST,
)
PATH: Final = Argument("a path", lambda value: is_text(value) or isinstance(value, os.PathLike), 'e.g. "runs"')


def checked(kinds: Mapping[str, Argument]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that checks arguments by their names; None is allowed where it is the default.

    Args:
        kinds: kind of each argument; names that a function does not have are ignored.

    Raises:
        InvalidValue: at a call, the first argument of another kind.
    """

    def decorate(call: Callable[P, R]) -> Callable[P, R]:
        parameters = inspect.signature(call).parameters
        # an argument after *args has no position
        places = [name for name, one in parameters.items() if one.kind is one.POSITIONAL_OR_KEYWORD]
        optional = {name for name, parameter in parameters.items() if parameter.default is None}

        @functools.wraps(call)
        def check_and_call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name, value in (*zip(places, args, strict=False), *kwargs.items()):
                kind = kinds.get(name)
                if kind is None or (value is None and name in optional) or kind.fits(value):
                    continue
                raise InvalidValue(
                    f"{name} must be {kind.what}, not {reprlib.repr(value)}", where=call.__name__, hint=kind.hint
                )
            return call(*args, **kwargs)

        return check_and_call

    return decorate
