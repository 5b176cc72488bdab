"""The entries of GXSM's panel: what `set` and `get` reach, with all that is peculiar about it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

USER_UNITS: Final = {"Å": 1.0, "nm": 10.0, "µm": 1e4}
"""In ångström."""
_FLOAT: Final = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_ANGSTROM: Final = "Å"
_PADDING: Final = " " * 4
_NO_UNIT: Final = " " * 5
_DAC_STEP: Final = 0.422
"""In ångström: a range is never less."""


@dataclass
class GxsmEntry:
    """One.

    Attributes:
        value: lengths in ångström, whatever the panel shows.
        unit: that `gets` shows; of lengths the user's.
        shown: how `gets` writes the number.
        zero: what 0 becomes.
        whole: of points.
        told: called with each new value.
    """

    value: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    shown: str = "{:.6g}"
    zero: float = 0.0
    whole: bool = False
    told: Callable[[float], None] | None = None


class GxsmEntries:
    """The entries by reference name.

    Args:
        user_unit: of lengths, as preferred.
        decimal_comma: GXSM runs in a country that writes 12,5.
        version: 3 or 4.
        dialogs: called with what a dialog on the screen says.
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
        """Inside: lengths in ångström."""
        return self._entries[ref].value

    def put(self, ref: str, value: float) -> None:
        """Set an entry as at the panel, lengths in ångström, without checks or side effects."""
        self._entries[ref].value = value

    def set(self, ref: str, text: str) -> int:
        """Always 0, whatever came of it."""
        entry = self._entries.get(ref)
        if entry is None:
            return 0
        value = self._atof(text) * self._factor(entry)
        value = (float(np.trunc(value)) if entry.whole else value) or entry.zero
        if not entry.low <= value <= entry.high:
            self._dialogs(f"Valid Range of {ref}: {entry.low} to {entry.high}")
            return 0
        if ref in ("StepsX", "StepsY"):
            ref, value = f"Range{ref[-1]}", value * max(self[f"Points{ref[-1]}"] - 1.0, 1.0)
        self._take(ref, value)
        if ref in ("RangeX", "PointsX"):  # the ratio is kept: here 1:1
            self._take(f"{ref[:-1]}Y", value)
        for axis in "XY":
            self.put(f"Steps{axis}", self[f"Range{axis}"] / max(self[f"Points{axis}"] - 1.0, 1.0))
        return 0

    def get(self, ref: str) -> float | str:
        """Return a value in the user's unit; of what there is not: -inf, or in Gxsm3 memory that nobody has written."""
        entry = self._entries.get(ref)
        if entry is not None:
            return entry.value / self._factor(entry)
        if self._version == 3:
            return "I\x025"
        return -math.inf

    def gets(self, ref: str) -> str:
        """Return a value as shown, by the first name that begins so."""
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
        if entry.told is not None:
            entry.told(value)

    def _factor(self, entry: GxsmEntry) -> float:
        return USER_UNITS[self._user_unit] if entry.unit == _ANGSTROM else 1.0

    def _atof(self, text: str) -> float:
        """Parse the longest numeric prefix, as C's atof does; 0 if there is none."""
        wanted = text.replace(".", "\0").replace(",", ".") if self._comma else text
        match = _FLOAT.match(wanted)
        return float(match[0]) if match else 0.0


def lengths(reach: float, told: Callable[[str], Callable[[float], None]]) -> dict[str, GxsmEntry]:
    """The entries of the scan frame that every GXSM has, in ångström, up to so far from the centre."""

    def length(ref: str, value: float, low: float, high: float) -> GxsmEntry:
        return GxsmEntry(value, low, high, _ANGSTROM, "{:.1f}", told=told(ref))

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
        "Rotation": GxsmEntry(0.0, -360.0, 360.0, "°", "{:6.0f}"),
        "script-control": GxsmEntry(50.0, 0.0, 100.0),
    }


def simulated_3() -> dict[str, GxsmEntry]:
    """Return the entries that the simulator of Gxsm3 has besides those of Gxsm4's."""
    return {
        "sim-stm-fbs-bias": GxsmEntry(0.1, -10.0, 10.0, "V"),
        "sim-stm-fbs-mx0-current-set": GxsmEntry(0.5, -100.0, 100.0, "nA"),
        "sim-stm-fbs-cp": GxsmEntry(0.0, 0.0, 200.0),
        "sim-stm-fbs-ci": GxsmEntry(0.0, 0.0, 200.0),
        "sim-config-adv-scan-slope-x": GxsmEntry(0.0, -0.2, 0.2),
        "sim-config-adv-scan-slope-y": GxsmEntry(0.0, -0.2, 0.2),
    }
