"""The entries of GXSM's panel: what `set` and `get` reach, with all that is peculiar about it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

USER_UNITS: Final = {"Å": 1.0, "nm": 10.0, "µm": 1e4}
"""In ångström."""
_FLOAT: Final = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_ANGSTROM: Final = "Å"


@dataclass
class Entry:
    """One.

    Attributes:
        value: lengths in ångström, whatever the panel shows.
        unit: that `gets` shows; of lengths the user's.
        whole: of points.
        told: called with each new value.
    """

    value: float
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    whole: bool = False
    told: Callable[[float], None] | None = None


class Entries:
    """All of them, by reference name.

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
        self._entries: dict[str, Entry] = {}

    def add(self, ref: str, entry: Entry) -> None:
        self._entries[ref] = entry

    def names(self) -> tuple[str, ...]:
        return tuple(self._entries)

    def __contains__(self, ref: str) -> bool:
        return ref in self._entries

    def __getitem__(self, ref: str) -> float:
        """Inside: lengths in ångström."""
        return self._entries[ref].value

    def put(self, ref: str, value: float) -> None:
        """As somebody at the panel, lengths in ångström: nothing is refused, nothing else follows."""
        self._entries[ref].value = value

    def set(self, ref: str, text: str) -> int:
        """Always 0, whatever came of it."""
        entry = self._entries.get(ref)
        if entry is None:
            return 0
        value = self._atof(text) * self._factor(entry)
        value = float(int(value)) if entry.whole else value
        if not entry.low <= value <= entry.high:
            self._dialogs(f"Valid Range of {ref}: {entry.low} to {entry.high}")
            return 0
        self._take(ref, value)
        if ref in ("RangeX", "PointsX", "StepsX"):  # the ratio is kept: here 1:1
            self._take(f"{ref[:-1]}Y", value)
        return 0

    def get(self, ref: str) -> float:
        """In the user's unit.

        Raises:
            UnicodeDecodeError: there is none, in Gxsm3 (memory that nobody has written).
        """
        entry = self._entries.get(ref)
        if entry is not None:
            return entry.value / self._factor(entry)
        if self._version == 3:
            raise UnicodeDecodeError("utf-8", b"\xe0\x04", 0, 1, "invalid continuation byte")
        return -math.inf

    def gets(self, ref: str) -> str:
        """As shown; by the last name that begins so."""
        found = [entry for name, entry in self._entries.items() if name.startswith(ref)]
        if not found:
            return "ERROR"
        entry = found[-1]
        number = f"{entry.value / self._factor(entry):.1f}" if entry.unit == _ANGSTROM else f"{entry.value:.6g}"
        unit = self._user_unit if entry.unit == _ANGSTROM else entry.unit
        return f"{number.replace('.', ',') if self._comma else number} {unit}    "

    def _take(self, ref: str, value: float) -> None:
        entry = self._entries[ref]
        entry.value = value
        if entry.told is not None:
            entry.told(value)

    def _factor(self, entry: Entry) -> float:
        return USER_UNITS[self._user_unit] if entry.unit == _ANGSTROM else 1.0

    def _atof(self, text: str) -> float:
        """What C makes of a text: as much of it as is a number, 0 of what is none."""
        wanted = text.replace(".", "\0").replace(",", ".") if self._comma else text
        match = _FLOAT.match(wanted)
        return float(match[0]) if match else 0.0


def lengths(reach: float, told: Callable[[str], Callable[[float], None]]) -> dict[str, Entry]:
    """The entries of the scan frame that every GXSM has, in ångström, up to so far from the centre."""

    def length(ref: str, value: float, low: float, high: float) -> Entry:
        return Entry(value, low, high, _ANGSTROM, told=told(ref))

    return {
        "RangeX": length("RangeX", 1e4, 0.0, 2 * reach),
        "RangeY": length("RangeY", 1e4, 0.0, 2 * reach),
        "PointsX": Entry(64.0, 2.0, 8192.0, whole=True),
        "PointsY": Entry(64.0, 2.0, 8192.0, whole=True),
        "StepsX": length("StepsX", 1e4 / 63, 0.0, 2 * reach),
        "StepsY": length("StepsY", 1e4 / 63, 0.0, 2 * reach),
        "OffsetX": length("OffsetX", 0.0, -reach, reach),
        "OffsetY": length("OffsetY", 0.0, -reach, reach),
        "ScanX": length("ScanX", 0.0, -reach, reach),
        "ScanY": length("ScanY", 0.0, -reach, reach),
        "Rotation": Entry(0.0, -360.0, 360.0, "deg"),
        "script-control": Entry(0.0, 0.0, 10.0),
    }
