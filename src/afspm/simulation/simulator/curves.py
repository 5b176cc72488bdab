"""The settings of curves at the panel of the simulated controller: each kind has some of its own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from afspm.model import names
from afspm.simulation.spectra import SweptCurve
from afspm.simulation.world import WorldSettings
from afspm.translator.parameters import Value

OF_KIND: Final = (*names.SPEC_Z_ENDS, names.SPEC_POINTS, names.SPEC_POINT_TIME)
"""The settings that each kind of curve has for itself."""


def at_first(kind: str, world: WorldSettings) -> dict[str, float]:
    """Return the settings of a kind of curve before they are changed, by generic names, in SI."""
    iv, force, z = world.iv, world.force, world.z
    of_kind = world.of_curves(kind)
    nearest_m, farthest_m = (z.nearest_m, z.farthest_m) if kind == "z" else (-force.range_m, force.range_m)
    return {
        names.SPEC_FROM: -iv.range_v,
        names.SPEC_TO: iv.range_v,
        names.SPEC_Z_FROM: nearest_m,
        names.SPEC_Z_TO: farthest_m,
        names.SPEC_POINTS: of_kind.points,
        names.SPEC_POINT_TIME: of_kind.duration_s / (2.0 * of_kind.points),
        names.SPEC_Z_OFFSET: 0.0,
        names.LOCK_IN_AMPLITUDE: iv.modulation_v,
    }


def swept(kind: str, values: Mapping[str, Value]) -> SweptCurve:
    """Return a curve with these settings, by generic names, in SI; a table of parameters may lack some."""

    def number(name: str) -> float | None:
        return float(values[name]) if name in values else None

    first, last = map(number, names.SPEC_ENDS if kind == "IV" else names.SPEC_Z_ENDS)
    points = number(names.SPEC_POINTS)
    return SweptCurve(
        None if first is None or last is None else (first, last),
        None if points is None else int(points),
        number(names.SPEC_POINT_TIME),
        number(names.SPEC_Z_OFFSET) or 0.0,
        number(names.LOCK_IN_AMPLITUDE),
    )
