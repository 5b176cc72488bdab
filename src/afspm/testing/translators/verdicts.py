"""What a check says: nothing if all is well, else what was expected and what came, in one line."""

from __future__ import annotations

import math


class Failed(AssertionError):
    """The translator does not do what the wire format says.

    Args:
        expected, came: in words of a physicist, without a full stop.
    """

    def __init__(self, expected: str, came: str) -> None:
        super().__init__(f"expected {expected}; came {came}")


class Skipped(Exception):
    """It can't be checked here; the text says why."""


class Lost(Exception):
    """Nothing more can be checked: a process has ended, or control was taken away."""


def expect(holds: object, expected: str, came: str) -> None:
    """Raises Failed unless it holds."""
    if not holds:
        raise Failed(expected, came)


def near(a: float, b: float, relative: float = 1e-3, absolute: float = 0.0) -> bool:
    """Whether two numbers are the same to a controller's precision."""
    return math.isclose(a, b, rel_tol=relative, abs_tol=absolute)
