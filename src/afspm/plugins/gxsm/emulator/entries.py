"""Entries of GXSM's panel that `set` and `get` use, with their quirks."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

USER_UNITS: Final = {"Å": 1.0, "nm": 10.0, "µm": 1e4}
"""Units of lengths on the panel, in ångström."""
_FLOAT: Final = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_ANGSTROM: Final = "Å"
_PADDING: Final = " " * 4
_NO_UNIT: Final = " " * 5
_DAC_STEP: Final = 0.422
"""Smallest range, in ångström: one step of the converter."""


@dataclass
class GxsmEntry:
    """An entry of GXSM's panel.

    Attributes:
        value: present value; lengths in ångström, independent of the panel's unit.
        low, high: limits of accepted values, in the unit of `value`.
        unit: unit that `gets` shows, replaced by the user's unit for lengths.
        shown: format of the number in `gets`.
        step: smallest value above zero, which replaces 0 and all values between.
        whole: True for numbers of points.
        on_change: called with each new value.
    """

    value: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    shown: str = "{:.6g}"
    step: float = 0.0
    whole: bool = False
    on_change: Callable[[float], None] | None = None


class GxsmEntries:
    """The entries by reference name.

    Args:
        version: 3 or 4.
        user_unit: preferred unit of lengths.
        decimal_comma: True for a locale with decimal commas, 12,5.
        dialogs: receives the texts of dialogs on the screen.
    """

    def __init__(self, version: int, user_unit: str, *, decimal_comma: bool, dialogs: Callable[[str], None]) -> None:
        self._version = version
        self._user_unit = user_unit
        self._comma = decimal_comma
        self._dialogs = dialogs
        self._entries: dict[str, GxsmEntry] = {}

    def add(self, ref: str, entry: GxsmEntry) -> None:
        self._entries[ref] = entry

    def names(self) -> tuple[str, ...]:
        return tuple(self._entries)

    def __contains__(self, ref: str) -> bool:
        return ref in self._entries

    def __getitem__(self, ref: str) -> float:
        """Return the value of an entry; lengths are in ångström."""
        return self._entries[ref].value

    def put(self, ref: str, value: float) -> None:
        """Set an entry without checks or side effects; lengths are in ångström."""
        self._entries[ref].value = value

    def set(self, ref: str, text: str, *, takes_all: bool = False) -> int:
        """Set an entry from text. Return 0 even after a failure, as GXSM does.

        Args:
            takes_all: True takes the value as it is, also beyond the limits.
        """
        entry = self._entries.get(ref)
        if entry is None:
            return 0
        value = self._atof(text) * self._factor(entry)
        if not takes_all:
            value = float(np.trunc(value)) if entry.whole else value
            value = entry.step if 0.0 <= value < entry.step else value
        # GXSM keeps the old value, returns 0, and shows a dialog on the screen
        if not (takes_all or entry.low <= value <= entry.high):
            self._dialogs(f"Valid Range of {ref}: {entry.low} to {entry.high}")
            return 0
        if ref in ("StepsX", "StepsY"):
            ref, value = f"Range{ref[-1]}", value * max(self[f"Points{ref[-1]}"] - 1.0, 1.0)
        self._take(ref, value)
        if ref in ("RangeX", "PointsX"):  # GXSM keeps the aspect ratio, here always 1:1
            self._take(f"{ref[:-1]}Y", value)
        for axis in "XY":
            self.put(f"Steps{axis}", self[f"Range{axis}"] / max(self[f"Points{axis}"] - 1.0, 1.0))
        return 0

    def get(self, ref: str) -> float | str:
        """Return a value in the user's unit; an unknown name gives -inf, or uninitialised memory in Gxsm3."""
        entry = self._entries.get(ref)
        if entry is not None:
            return entry.value / self._factor(entry)
        if self._version == 3:
            return "I\x025"
        return -math.inf

    def gets(self, ref: str) -> str:
        """Return the first entry whose name starts with `ref`, as text with its unit; "ERROR" if there is none."""
        found = [entry for name, entry in self._entries.items() if name.startswith(ref)]
        if not found:
            return "ERROR"
        entry = found[0]
        number = entry.shown.format(entry.value / self._factor(entry))
        unit = f"{self._user_unit}{_PADDING}" if entry.unit == _ANGSTROM else entry.unit
        return f"{number.replace('.', ',') if self._comma else number} {unit}"

    def _take(self, ref: str, value: float) -> None:
        entry = self._entries[ref]
        entry.value = value
        if entry.on_change is not None:
            entry.on_change(value)

    def _factor(self, entry: GxsmEntry) -> float:
        return USER_UNITS[self._user_unit] if entry.unit == _ANGSTROM else 1.0

    def _atof(self, text: str) -> float:
        # C's atof reads the longest numeric prefix, and 0 if there is none: "1.5nm" is 1.5, "abc" is 0.
        wanted = text.replace(".", "\0").replace(",", ".") if self._comma else text
        match = _FLOAT.match(wanted)
        return float(match[0]) if match else 0.0


def lengths(reach: float, on_change: Callable[[str], Callable[[float], None]]) -> dict[str, GxsmEntry]:
    """Return the entries that every GXSM has: scan frame, tip position, `script-control`.

    Args:
        reach: highest offset from the scanner's centre, in ångström.
        on_change: returns the callback of an entry.
    """

    def length(ref: str, value: float, low: float, high: float) -> GxsmEntry:
        return GxsmEntry(value, low, high, _ANGSTROM, "{:.1f}", on_change=on_change(ref))

    def extent(value: float, shown: str) -> GxsmEntry:
        return GxsmEntry(value, 0.0, 2 * reach, _ANGSTROM, shown, _DAC_STEP)

    return {
        "RangeX": extent(1e4, "{:.1f}"),
        "RangeY": extent(1e4, "{:.1f}"),
        "PointsX": GxsmEntry(64.0, 2.0, 20_000.0, _NO_UNIT, whole=True),
        "PointsY": GxsmEntry(64.0, 2.0, 20_000.0, _NO_UNIT, whole=True),
        "StepsX": extent(1e4 / 63, "{:.3f}"),
        "StepsY": extent(1e4 / 63, "{:.3f}"),
        "OffsetX": length("OffsetX", 0.0, -reach, reach),
        "OffsetY": length("OffsetY", 0.0, -reach, reach),
        "ScanX": length("ScanX", 0.0, -reach, reach),
        "ScanY": length("ScanY", 0.0, -reach, reach),
        "Rotation": GxsmEntry(0.0, -360.0, 360.0, "°", "{:6.0f}", on_change=on_change("Rotation")),
        "script-control": GxsmEntry(50.0, 0.0, 100.0),
    }


def subscan(on_change: Callable[[int], Callable[[float], None]]) -> dict[str, GxsmEntry]:
    """Return the entries of *SubScan*, which only Gxsm4 lists: first column, columns, first row, rows.

    Args:
        on_change: returns the callback of an entry, by its place in this list.
    """
    refs = ("SPMC-sls-xs", "SPMC-sls-xn", "SPMC-sls-ys", "SPMC-sls-yn")
    return {
        ref: GxsmEntry(0.0, 0.0, 99_999.0, shown="{:.0f}", whole=True, on_change=on_change(place))
        for place, ref in enumerate(refs)
    }


def simulated_3() -> dict[str, GxsmEntry]:
    """Return the entries that only Gxsm3's simulator has."""
    return {
        "sim-stm-fbs-bias": GxsmEntry(0.1, -10.0, 10.0, "V"),
        "sim-stm-fbs-mx0-current-set": GxsmEntry(0.5, -100.0, 100.0, "nA"),
        "sim-stm-fbs-cp": GxsmEntry(0.0, 0.0, 200.0),
        "sim-stm-fbs-ci": GxsmEntry(0.0, 0.0, 200.0),
        "sim-config-adv-scan-slope-x": GxsmEntry(0.0, -0.2, 0.2),
        "sim-config-adv-scan-slope-y": GxsmEntry(0.0, -0.2, 0.2),
    }
