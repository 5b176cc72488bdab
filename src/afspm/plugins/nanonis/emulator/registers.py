"""Settings without effect on the emulation: pairs of functions `…Set` and `…Get` that only store values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

from afspm.plugins.nanonis.emulator import wire

Values = tuple[Any, ...]

AT_FIRST: Final[dict[str, Values]] = {
    "ZCtrl.SwitchOffDelay": (0.05,),
    "ZCtrl.WithdrawRate": (1e-6,),
    "ZCtrl.Limits": (1e-6, -1e-6),
    "BiasSpectr.Timing": (0.05, 0.0, 0.005, math.inf, 0.002, 0.001, 0.005, 0.2),
    "BiasSpectr.AdvProps": (1, 1, 0, 0),
    "BiasSpectr.MLSMode": ("Linear",),
    "ZSpectr.Range": (0.0, 120e-9),
    "ZSpectr.Timing": (0.05, 0.005, math.inf, 0.002, 0.001, 0.005, 0.2),
    "Bias.Calibr": (1.0, 0.0),
    "Piezo.Sens": (3.8e-9, 3.8e-9, 0.9e-9),
    "Piezo.XYZLimits": (0, -10.0, 10.0, -10.0, 10.0, -10.0, 10.0),
    "TipShaper.Props": (0.1, 0, 0.0, -1e-9, 0.1, 0.0, 0.1, 1e-9, 0.1, 0.1, 1),
    "Util.RTFreq": (20e3,),
    "Util.AcqPeriod": (0.02,),
    "Util.RTOversampl": (10,),
    "FolMe.Oversampl": (10, 0.01),
    "SafeTip.Props": (0, 1, 1e-9),
    "LockIn.ModAmp": (0.02,),
    "LockIn.ModPhasFreq": (973.0,),
    "PLL.CenterFreq": (30e3,),
    "PLL.AmpCtrlSetpnt": (100e-12,),
    "UserOut.Limits": (10.0, -10.0),
    "Pattern.Props": ("Bias Spectroscopy", "Grid_Spectroscopy", "", 0.0, 0),
    "Pattern.Grid": (10, 10, 0.0, 0.0, 100e-9, 100e-9, 0.0),
    "Pattern.Line": (10, 0.0, 0.0, 100e-9, 0.0),
    "Current.Gain": (6,),
}
_KEYED_OTHERWISE: Final[dict[str, tuple[tuple[int, ...], tuple[int, ...]]]] = {
    "Motor.FreqAmp": ((2,), (0, 1)),
    "UserOut.Limits": ((0, 3), (1, 2)),
    "Pattern.Grid": ((), (1, 2, 4, 5, 6, 7, 8)),
    "Pattern.Line": ((), (1, 3, 4, 5, 6)),
    "Pattern.Cloud": ((), (1, 2, 3)),
    "APRFGen.Freq": ((), (1,)),
    "APRFGen.Power": ((), (1,)),
}
"""Positions of arguments of `…Set`: arguments that name the item, and arguments that `…Get` returns.

For other registers, the first arguments are the arguments of `…Get`, which name the item; all further arguments are
returned in order."""

_OTHER_NAMES: Final = {"AtomTrack.StatusGet": "AtomTrack.Ctrl"}
"""Getters and setters with different names."""


class Registers:
    """Values set by clients, by function name without the suffix "Set" and by item (number of a modulator …)."""

    def __init__(self) -> None:
        self._kept: dict[tuple[str, Values], Values] = {}

    def set(self, name: str, arguments: Sequence[object]) -> None:
        """Store the arguments of a function.

        Raises:
            ValueError: an argument is not among its choices.
        """
        register = name.removesuffix("Set")
        fields = wire.functions()[name].arguments
        by, taken = _parts(register, len(arguments))
        key = (register, tuple(arguments[n] for n in by))
        before = self.get(register, key[1])
        now = list(before) + [None] * (len(taken) - len(before))
        for place, n in enumerate(taken):
            now[place] = _set(fields[n].mark, arguments[n], now[place])
        self._kept[key] = tuple(now)

    def put(self, register: str, *values: object) -> None:
        """Store the values of a register without an item."""
        self._kept[register, ()] = values

    def get(self, register: str, belongs_to: Sequence[object] = ()) -> Values:
        """Return the stored or initial values; empty if there are none."""
        return self._kept.get((register, tuple(belongs_to)), AT_FIRST.get(register, ()))

    def changed(self, register: str, *belongs_to: object) -> Values | None:
        """Return the values that a client has set; None as long as they are the initial ones."""
        return self._kept.get((register, belongs_to))

    def got(self, name: str, arguments: Sequence[object]) -> Values:
        """Return the results of a function `…Get`, one for each field; fields without a value are zero or empty."""
        kept = self.get(_OTHER_NAMES.get(name, name.removesuffix("Get")), arguments)
        codes = [field.code for field in wire.functions()[name].results]
        zeros = tuple(wire.ZEROS[code] for code in codes)
        known = tuple(zeros[n] if value is None else value for n, value in enumerate(kept[: len(codes)]))
        return known + zeros[len(known) :]


def _parts(register: str, count: int) -> tuple[Sequence[int], Sequence[int]]:
    if register in _KEYED_OTHERWISE:
        return _KEYED_OTHERWISE[register]
    getter = wire.functions().get(f"{register}Get")
    keys = len(getter.arguments) if getter is not None else _keys_without_getter(register)
    return range(keys), range(keys, count)


def _keys_without_getter(register: str) -> int:
    other = next((name for name, same in _OTHER_NAMES.items() if same == register), None)
    return len(wire.functions()[other].arguments) if other is not None else 0


def _set(mark: str, value: Any, before: object) -> object:
    if isinstance(value, float) and math.isnan(value):
        return before
    if mark == "?":
        if value not in (0, 1, 2):
            raise ValueError(f"{value} is none of the choices")
        return (before or 0) if value == 0 else int(value == 1)
    if mark == "-":
        return (before or 0) if value == 0 else value - 1
    if mark and value == float(mark[1:]):
        return before
    return value
