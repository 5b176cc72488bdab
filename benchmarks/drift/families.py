"""Families of pairs with varied surface, tip, instrument and displacement.

Pairs of `SURFACES` and `CONDITIONS` differ only by noise and place, so tuning on them would overfit. Here all
parameters are drawn. There are two halves: everything tuned is fitted on "fitted", and reported figures are from
"unseen", whose seeds (and, of real images, whose samples) no tuning uses. A gap between both halves shows overfitting:
an estimator that met its targets on the fixed surfaces refused half of the right matches on another program's lattice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from afspm.components import Array
from benchmarks.drift.conditions import CONDITIONS, WANDERS, Condition
from benchmarks.drift.surfaces import SURFACES, Grid, Random, contaminated

Half = Literal["fitted", "unseen"]
HALVES: tuple[Half, ...] = ("fitted", "unseen")
Relief = Callable[[Grid, Random, Random], Array]


def source(half: Half, *numbers: int) -> Random:
    """Return a random generator that shares no numbers with the other half."""
    return np.random.default_rng([1 + HALVES.index(half), *numbers])


def drawn_surface(name: str, random: Random) -> Relief:
    """Return a surface of a kind with drawn parameters."""
    u, log = random.uniform, partial(_log_uniform, random)
    parameters: dict[str, dict[str, float]] = {
        "stamper": {
            "pitch": u(55.0, 120.0), "half_width": u(7.0, 22.0), "bit": u(9.0, 24.0), "flank": u(2.0, 9.0),
            "turned_deg": 45.0, "texture": log(0.004, 0.06), "texture_px": log(3.0, 15.0),
        },
        "rough": {"longest_px": log(8.0, 80.0), "hurst": u(0.5, 1.0)},
        "particles": {
            "area_px2": log(150.0, 1500.0), "radius_px": log(2.5, 7.0), "spread": u(0.1, 0.5),
            "ground": log(0.04, 0.5), "ground_px": log(4.0, 30.0),
        },
        "lattice": {
            "spacing": log(5.0, 16.0), "defects": log(4.0, 25.0), "depth": u(2.0, 4.5), "stretch": u(0.85, 1.15),
            "texture": random.choice((0.0, u(0.0, 0.3))),
        },
        "steps": {
            "terrace": log(22.0, 90.0), "edge": u(1.5, 6.0), "wander": u(0.2, 0.7), "wander_px": log(15.0, 60.0),
            "kinks": u(0.0, 0.15), "texture": log(0.003, 0.05),
        },
    }  # fmt: skip
    made = partial(SURFACES[name], **parameters[name])
    blobs = random.choice((0.0, u(0.0, 8.0)))
    return lambda grid, specimen, place: contaminated(made(grid, specimen, place), grid, place, blobs=blobs)


def drawn_condition(name: str, random: Random) -> Condition:
    """Return the condition of that name with drawn parameters."""
    u, log, likely = random.uniform, partial(_log_uniform, random), partial(_likely, random)
    usual = CONDITIONS[name]
    if not usual.drift_px:
        return replace(usual, white=usual.white * log(0.5, 2.0), overlap=(0.6, 1.0), aspect=log(0.8, 1.25))
    hard = usual.rotation_deg > 0.0
    if usual.wander_px:
        usual = _wandering(usual, random)
    return replace(
        usual,
        white=usual.white * log(0.5, 2.0),
        row_offset=usual.row_offset * log(0.3, 2.0),
        row_memory=likely(0.5) * u(0.0, 0.9),
        row_tilt=likely(0.3) * u(0.0, 0.2),
        one_over_f=usual.one_over_f * log(0.3, 2.0),
        exponent=u(0.8, 1.4),
        scars=usual.scars * u(0.0, 2.0),
        scar_rows=3,
        spikes=likely(0.3) * log(1e-4, 3e-3),
        lost=likely(0.2) * u(0.0, 0.03),
        tilt=u(0.0, 3.0),
        bow=likely(0.3) * u(0.0, 0.5),
        flatten=(None, 0, 1, 1, 1, 2)[random.integers(6)],
        drift_px=usual.drift_px * log(0.3, 2.0),
        calibration=likely(0.5) * 0.01,
        creep_px=likely(0.3) * u(0.0, 1.0),
        creep_length_px=u(3.0, 10.0),
        aspect=1.0 if likely(0.6) else log(0.7, 1.4),
        overlap=(0.4, 0.7) if hard else (0.6, 1.0),
        blunt=log(0.4, 4.0),
        double_px=likely(0.15) * u(1.5, 5.0),
        turned_round=bool(likely(0.1)),
    )


def _wandering(usual: Condition, random: Random) -> Condition:
    u, log, likely = random.uniform, partial(_log_uniform, random), partial(_likely, random)
    turn = u(0.0, 2.0 * math.pi)
    slow_px = likely(0.4) * log(0.1, 1.0)
    return replace(
        usual,
        wander_px=likely(0.7) * log(0.02, 0.3),
        wander_rows=log(4.0, 40.0),
        wander=str(random.choice(WANDERS)),
        slow_creep_px=(slow_px * math.cos(turn), slow_px * math.sin(turn)),
        slow_creep_rows=log(4.0, 20.0),
    )


def _likely(random: Random, probability: float) -> float:
    return float(random.random() < probability)


def _log_uniform(random: Random, low: float, high: float) -> float:
    return math.exp(random.uniform(math.log(low), math.log(high)))
