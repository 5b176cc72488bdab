"""Simulated scans for judging tips: the same sample, with a tip that changes on command."""

from __future__ import annotations

from functools import cache

from afspm.model import Region, Scan
from afspm.simulation import World

SIZE_M = 1e-6
PIXELS = 96
CHANGED_S = 1e5
HOME = Region((0.0, 0.0), (SIZE_M, SIZE_M))
ELSEWHERE = Region((4e-6, 3e-6), (SIZE_M, SIZE_M))


def world(seed: int, condition: str = "sharp", surface: str = "particles") -> World:
    changes = {"schedule": [[CHANGED_S, condition]]}
    return World.from_settings({"surface": {"kind": surface}, "tip_changes": changes}, seed, 0.0)


@cache
def channels(seed: int, condition: str, number: int, surface: str = "particles") -> tuple[tuple[Scan, Scan], ...]:
    """Return `number` scans of HOME before and after the change of the tip, and one of ELSEWHERE each."""
    made = world(seed, condition, surface)
    times = [200.0 * i for i in range(number)] + [CHANGED_S + 200.0 * (i + 1) for i in range(number)]
    places = [HOME] * len(times)
    places[number - 1] = places[-1] = ELSEWHERE
    pairs = []
    for t, place in zip(times, places, strict=True):
        scan = made.scan(place, (PIXELS, PIXELS), 0.5, t)
        values = scan.channels()
        time_ns = int(scan.end_s * 1e9)
        trace, retrace = (Scan(place, name, "m", values[name][1], time_ns) for name in ("Height", "Height Retrace"))
        pairs.append((trace, retrace))
    return tuple(pairs)
