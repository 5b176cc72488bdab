"""The faults of the emulated Nanonis, and senseless replies: fields of the right type with random values."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Final

import numpy as np

FAULT_KINDS: Final[Mapping[str, str]] = {
    "no-reply": "a request is not answered",
    "slow": "a reply comes later, by the duration",
    "dialog": "a dialog waits on the screen: nothing is answered for the duration",
    "cut": "the connection is cut instead of a reply",
    "truncated": "half a reply, then the connection is cut",
    "error": "a reply with an error",
    "refused": "an error in reply to what sets or starts something",
    "wrong-name": "the reply to another function",
    "wrong-release": "for the duration, replies have the fields of another release",
    "garbage": "bytes that are not a reply",
    "huge": "a reply that announces two gigabytes",
    "not-utf8": "texts that are not UTF-8",
    "nan": "NaN for every number",
    "nonsense": "for the duration, well-formed replies with absurd values",
    "crash": "the software crashes",
    "file-late": "a file appears only after the duration",
    "half-file": "a file is half written, and whole only after the duration",
    "file-missing": "a file is announced but never written",
    "stale-name": "the file of the previous scan is announced for a scan",
    "autosave-off": "scans and spectra are not saved for the duration, whatever is set",
    "late-start": "a scan begins, and is reported as running, only after the duration",
    "no-start": "a scan does not begin, without an error",
    "ends-at-once": "for the duration, waiting for the end of a scan returns at once if none runs",
    "safe-tip": "the safe tip withdraws the tip and ends the scan",
    "safe-tip-unnoticed": "the safe tip withdraws the tip, and the scan goes on in the air",
    "panel-stop": "the scan is stopped at the panel",
}

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


def senseless_value(code: str, chance: random.Random) -> object:
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
