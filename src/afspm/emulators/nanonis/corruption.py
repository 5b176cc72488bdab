"""Senseless replies: fields of the right type with values that make no sense."""

from __future__ import annotations

import random
from typing import Any, Final

import numpy as np

_NUMBERS: Final = (float("nan"), float("inf"), -float("inf"), 0.0, -1.0, 1e-38, 3e38, -3e38, 1e9)
_INTEGERS: Final = (0, 1, 2, 3, 7, 127, 500, 65535, 2**31 - 1, -1, -(2**31))
_TEXTS: Final = (
    "",
    "\0",
    "../..",
    "x" * 3000,
    "Z (m)",
    "Current (A)",
    "(",
    "ä€",
    "C:\\nowhere\\at all.sxm",
    "/nowhere/a.dat",
)


def senseless_value(code: str, chance: random.Random) -> Any:
    """A value of the field, by its code."""
    if code in "fd":
        return chance.choice(_NUMBERS)
    if code in "BHIin":
        return chance.choice(_INTEGERS)
    if code == "S":
        return chance.choice(_TEXTS)
    if code == "2f":
        shape = chance.randrange(4), chance.randrange(4)
        return np.reshape([chance.choice(_NUMBERS) for _ in range(shape[0] * shape[1])], shape)
    if code == "2S":
        return [[chance.choice(_TEXTS) for _ in range(chance.randrange(3))] for _ in range(chance.randrange(3))]
    item = "S" if code == "A" else code[1]
    return [senseless_value(item, chance) for _ in range(chance.randrange(4))]
