"""Numbers, times and names as a person reads them."""

from __future__ import annotations

import html
import math
from datetime import datetime

from afspm import formatting
from afspm.clock import NS_PER_S

_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"),
             (1e-12, "p"), (1e-15, "f"))  # fmt: skip
PREFIXABLE = frozenset({"m", "V", "A", "s", "N", "Hz", "W", "F", "m/s", "m/V", "V/m", "C", "Pa", "Ohm", "Ω", "T", "g"})


def scale(largest: float, unit: str) -> tuple[float, str]:
    """(factor, unit with prefix) in which numbers up to `largest` read well: shown = value * factor."""
    if unit not in PREFIXABLE or not math.isfinite(largest) or largest == 0.0:
        return 1.0, unit
    # what rounds up to a thousand belongs to the next prefix
    size = abs(largest) * 1.0005
    power, prefix = next(((p, name) for p, name in _PREFIXES if size >= p), _PREFIXES[-1])
    return 1.0 / power, prefix + unit


def quantity(value: float | None, unit: str, digits: int = 4) -> str:
    """ "12.34 nm"; "–" for what there is no number for."""
    if value is None or not math.isfinite(value):
        return "–"
    factor, shown = scale(value, unit)
    return f"{value * factor:.{digits}g} {shown}".strip()


def position(xy_m: tuple[float, float]) -> str:
    """ "(1.2, −0.5) µm"."""
    return formatting.typeset(formatting.position_text(xy_m))


def area(size_m: tuple[float, float]) -> str:
    """ "2 × 1 µm"."""
    return formatting.typeset(formatting.area_text(size_m))


def date_and_clock(time_ns: int) -> str:
    """Day and time, with the zone."""
    return f"{formatting.day_and_time(time_ns)} {_local(time_ns):%Z}"


def escape(text: str) -> str:
    """As content or attribute of HTML."""
    return html.escape(text, quote=True)


def colour_class(name: str) -> str:
    """A class of the style sheet that is the same for a name wherever it is shown."""
    return f"tint-{sum(ord(letter) * (i + 7) for i, letter in enumerate(name)) % 8}"


def _local(time_ns: int) -> datetime:
    return datetime.fromtimestamp(time_ns / NS_PER_S).astimezone()
