"""Simulated scans of one place, the last with a tip that changes on the way."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial

import numpy as np
from client_lab import Lab

from afspm.emulation import World
from afspm.model import Region, Scan, ScanLines

HOME = Region((0.0, 0.0), (1e-6, 1e-6))
ROWS, LINE_S, PERIOD_S = 64, 0.5, 60.0
CHANGED_ROW, LEARNT = 30, 3
CHANNELS = ("Height", "Height Retrace")
Picture = Mapping[str, np.ndarray[tuple[int, int], np.dtype[np.float64]]]


def scan_at(world: World, number: int, direction: str, region: Region = HOME) -> Picture:
    scan = world.scan(region, (ROWS, ROWS), LINE_S, number * PERIOD_S, direction=direction)
    return {name: scan.channels()[name][1] for name in CHANNELS}


def world_with(flaw: str, changed_s: float) -> World:
    """Return a world in which the tip changes at a time."""
    settings = {
        "surface": {"kind": "particles"},
        "drift": {"velocity_m_per_s": [0.02e-9, -0.02e-9, 0.0]},
        "tip_changes": {"schedule": [[changed_s, flaw]]},
    }
    return World.from_settings(settings, 5, 0.0)


@cache
def night(flaw: str = "double", direction: str = "up") -> tuple[Picture, ...]:
    """Return three scans to learn from, one more good one, and one with a change in its middle."""
    world = world_with(flaw, (LEARNT + 1) * PERIOD_S + CHANGED_ROW * LINE_S)
    return tuple(scan_at(world, number, direction) for number in range(LEARNT + 2))


def steps(jump: tuple[int, int]) -> tuple[Picture, ...]:
    """Return scans of steps: three to learn from, one in which the sample jumps by (rows, columns), one after it."""
    settings = {"surface": {"kind": "steps", "angle_deg": 87.0}, "drift": {"velocity_m_per_s": [0.02e-9, 0.0, 0.0]}}
    world, jumped = (World.from_settings(settings, 5, 0.0) for _ in range(2))
    pixel_m = HOME.size_m[0] / ROWS
    region = Region((jump[1] * pixel_m, jump[0] * pixel_m), HOME.size_m)
    before = [scan_at(world, number, "up") for number in range(LEARNT + 1)]
    after = [scan_at(jumped, number, "up", region) for number in range(LEARNT + 2)]
    upper = np.arange(ROWS)[:, None] >= CHANGED_ROW
    jumping = {name: np.where(upper, after[LEARNT][name], before[LEARNT][name]) for name in CHANNELS}
    return (*before[:LEARNT], jumping, after[-1])


def began_ns(number: int) -> int:
    return round((1_700_000_000.0 + number * PERIOD_S) * 1e9)


def publish_lines(lab: Lab, picture: Picture, number: int, rows: range, at_s: float) -> None:
    """Publish the lines of a running scan one by one, all at one time."""
    for row in rows:
        for channel in CHANNELS:
            values = picture[channel][row : row + 1]
            lines = ScanLines(HOME, (ROWS, ROWS), channel, "m", row, values, began_ns(number))
            lab.at(at_s, partial(lab.publish, lines))


def publish_scan(lab: Lab, picture: Picture, number: int, at_s: float) -> None:
    for channel in CHANNELS:
        scan = Scan(HOME, channel, "m", picture[channel], began_ns(number) + round(ROWS * LINE_S * 1e9))
        lab.at(at_s, partial(lab.publish, scan))
