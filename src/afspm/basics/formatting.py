"""Durations, lengths, times and quantities as text, for logs, terminals, pages and reports."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo

from afspm.basics.clock import NS_PER_S, utc_time

_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"),
             (1e-12, "p"), (1e-15, "f"), (1e-18, "a"))  # fmt: skip
# all other units (px, deg, min, %) are shown without a prefix
PREFIXABLE = frozenset(
    {"m", "V", "A", "s", "N", "Hz", "W", "F", "m/s", "m/V", "V/m", "C", "S", "Pa", "Ohm", "Ω", "T", "g", "J"}
)
LONGEST_FOREIGN = 200
"""Greatest number of characters shown of a text from outside, such as a message of a controller."""
_SINGLE = struct.Struct("<f")
_DAY_NS = 86_400 * NS_PER_S
_LENGTHS = ((1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"), (1e-12, "pm"))


def duration_text(seconds: float) -> str:
    """Return a duration in units and digits that suit its size.

    >>> [duration_text(s) for s in (8.2, 200, 725, 7500, 300_000)]
    ['8 s', '3 min 20 s', '12 min', '2 h 05 min', '3 d 11 h']
    """
    whole = max(0, round(seconds))
    if whole < 60:
        return f"{whole} s"
    if whole < 600:
        return f"{whole // 60} min {whole % 60:02} s"
    minutes = round(whole / 60)
    if minutes < 60:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02} min"
    hours = round(whole / 3600)
    return f"{hours // 24} d {hours % 24} h"


def lengths_text(values_m: Sequence[float], joined: str = ", ") -> str:
    """Return lengths as text in the unit that suits the largest length, in the notation of experiment files.

    >>> lengths_text([5e-7, 2.5e-7], " x ")
    '500 x 250 nm'
    """
    largest_m = max(map(abs, values_m))
    unit_m, unit = next(((size, name) for size, name in _LENGTHS if largest_m >= 0.99 * size), (1e-9, "nm"))
    return joined.join(f"{value_m / unit_m:.5g}" for value_m in values_m) + f" {unit}"


def area_text(size_m: Sequence[float]) -> str:
    """Return (width, height) of a region as text.

    >>> area_text((2e-6, 1e-6))
    '2 x 1 µm'
    """
    return lengths_text(size_m, " x ")


def position_text(xy_m: tuple[float, float]) -> str:
    """Return (x, y) as text.

    >>> position_text((1.2e-6, -5e-7))
    '(1.2, -0.5) µm'
    """
    numbers, unit = lengths_text(xy_m).rsplit(" ", 1)
    return f"({numbers}) {unit}"


def typeset(text: str) -> str:
    """Return a text with typographic multiplication and minus signs, for pages.

    >>> typeset("2 x 1 µm at (1.2, -0.5) µm")
    '2 × 1 µm at (1.2, −0.5) µm'
    """
    return text.replace(" x ", " × ").replace("-", "−")


def time_of_day(time_ns: int, zone: tzinfo | None = None, *, seconds: bool = True) -> str:
    """Return a time (ns since the Unix epoch) as a time of day, "22:04:31"; without `zone` in this computer's zone."""
    return f"{_moment(time_ns, zone):{'%H:%M:%S' if seconds else '%H:%M'}}"


def day_and_time(time_ns: int, zone: tzinfo | None = None, *, seconds: bool = True) -> str:
    """Return a date and time, "2026-11-20 22:04:31", in UTC "2026-11-20 22:04:31 UTC"."""
    return f"{_moment(time_ns, zone):{'%Y-%m-%d %H:%M:%S' if seconds else '%Y-%m-%d %H:%M'}}{_zone(zone)}"


def day(time_ns: int, zone: tzinfo | None = None) -> str:
    """Return a date, "2026-11-20"."""
    return f"{_moment(time_ns, zone):%Y-%m-%d}"


def period_text(begin_ns: int, end_ns: int, zone: tzinfo | None = None) -> str:
    """Return a period, "2026-11-20 22:04 to 23:10 UTC"; the end has a date only if it is on another day."""
    same = day(begin_ns, zone) == day(end_ns, zone)
    until = (
        time_of_day(end_ns, zone, seconds=False) + _zone(zone) if same else day_and_time(end_ns, zone, seconds=False)
    )
    return f"{_moment(begin_ns, zone):%Y-%m-%d %H:%M} to {until}"


def zone_offset_s(time_ns: int) -> float:
    """Return the lead of this computer's zone over UTC at a time; summer time may begin or end during a night."""
    offset = _moment(time_ns, None).utcoffset()
    return offset.total_seconds() if offset else 0.0


def zone_offsets_s(start_ns: int, end_ns: int) -> list[tuple[int, float]]:
    """Return the offsets of this computer's zone in a period, each with its first time: the start, and each change."""
    offsets = [(start_ns, zone_offset_s(start_ns))]
    for day_ns in range(start_ns, end_ns, _DAY_NS):
        before_ns, after_ns = day_ns, min(day_ns + _DAY_NS, end_ns)
        if (new_s := zone_offset_s(after_ns)) == offsets[-1][1]:
            continue
        while after_ns - before_ns > 1:
            middle_ns = (before_ns + after_ns) // 2
            before_ns, after_ns = (before_ns, middle_ns) if zone_offset_s(middle_ns) == new_s else (middle_ns, after_ns)
        offsets.append((after_ns, new_s))
    return offsets


def _zone(zone: tzinfo | None) -> str:
    return " UTC" if zone is UTC else ""


def _moment(time_ns: int, zone: tzinfo | None) -> datetime:
    time = utc_time(time_ns)
    try:
        return time.astimezone(zone)
    except OSError:  # Windows knows no local time before 1970
        return time


def scale(largest: float, unit: str) -> tuple[float, str]:
    """Return (factor, prefixed unit) to show numbers up to `largest`, a number in `unit`: shown = value * factor.

    The factor is 1 for a unit that takes no prefix, and for a `largest` of zero, NaN or infinity.
    """
    if unit not in PREFIXABLE or not math.isfinite(largest) or largest == 0.0:
        return 1.0, unit
    # a number that rounds up to a thousand, as 999.6 nm in three digits, belongs to the next prefix
    size = abs(largest) * 1.0005
    power, prefix = next(((p, name) for p, name in _PREFIXES if size >= p), _PREFIXES[-1])
    return 1.0 / power, prefix + unit


_PLAIN_DIGITS = 7


def quantity(value: float | None, unit: str, digits: int = 4) -> str:
    """Return a number with its unit, "12.34 nm"; "–" for None, NaN and infinity."""
    if value is None or not math.isfinite(value):
        return "–"
    factor, shown = scale(value, unit)
    rounded = float(f"{value * factor:.{digits}g}") + 0.0  # 20000, not 2e+04; 0, not -0
    return f"{rounded:.{max(digits, _PLAIN_DIGITS)}g} {shown}".strip()


def shortest_single(number: float) -> float:
    """Return the shortest decimal number of a single precision number: 0.1, not 0.10000000149011612.

    A limit of 0.1 would refuse the latter.
    """
    for digits in range(6, 9):
        decimal = float(f"{number:.{digits}g}")
        if _SINGLE.unpack(_SINGLE.pack(decimal)) == (number,):
            return decimal
    return float(f"{number:.9g}")  # nine digits distinguish any two of them


def typeset_position(xy_m: tuple[float, float]) -> str:
    """Return a position (x, y) in m as text for pages."""
    return typeset(position_text(xy_m))


def typeset_area(size_m: Sequence[float]) -> str:
    """Return a size (width, height) in m as text for pages."""
    return typeset(area_text(size_m))


def typeset_length(length_m: float) -> str:
    """Return a length in m as text for pages."""
    return typeset(lengths_text([length_m]))


def unit_text(unit: str) -> str:
    """Return a unit for texts: "um/s" as "µm/s"."""
    return f"µ{unit[1:]}" if unit.startswith("um") else unit


def counted(count: int, one: str, many: str = "") -> str:
    """Return a count with its noun: (1, "scan") as "1 scan", (2, "scan") as "2 scans"; `many`: irregular plural."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def escaped(text: str) -> str:
    """Return a text from outside, cut at `LONGEST_FOREIGN` characters, with non-printable characters escaped."""
    cut = "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text[:LONGEST_FOREIGN])
    return f"{cut}…" if len(text) > LONGEST_FOREIGN else cut
