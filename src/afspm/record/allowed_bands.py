"""The values that [conditions] allows, for drawings; the scheduler reads and enforces the conditions itself."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from afspm.basics.errors import AfspmError
from afspm.basics.units import si
from afspm.record.drawing.timeline import DrawnBand, TimelineCurve
from afspm.record.overview import Overview
from afspm.record.run_json import EXPERIMENT_FILE


@dataclass(frozen=True)
class WrittenBand:
    """The bounds of one parameter in a condition, as the experiment file has them; None: no bound."""

    condition: str
    low: str | float | None
    high: str | float | None


AllowedBands = Mapping[str, tuple[WrittenBand, ...]]
"""The bands of each instrument parameter, by its name."""


def allowed_bands(folder: Path) -> AllowedBands:
    """Return the bands with a lower or upper bound in the expanded experiment file of a run.

    Empty without such bands, or if the file can't be read.
    """
    try:
        document = tomllib.loads((folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    found: dict[str, tuple[WrittenBand, ...]] = {}
    conditions = document.get("conditions")
    for name, condition in conditions.items() if isinstance(conditions, dict) else ():
        for parameter, table in condition.items() if isinstance(condition, dict) else ():
            if isinstance(table, dict) and ("from" in table or "to" in table):
                found[parameter] = (*found.get(parameter, ()), WrittenBand(name, table.get("from"), table.get("to")))
    return found


def instrument_curves(overview: Overview, bands: AllowedBands) -> list[TimelineCurve]:
    """Return a curve, with its allowed bands, for each parameter of other instruments."""
    curves = []
    for name, one in sorted(overview.instruments.items()):
        converted = (_converted(band, one.unit) for band in bands.get(name, ()))
        shown = [band for band in converted if band is not None]
        curves.append(TimelineCurve(name, one.unit, one.times_ns, one.values, shown))
    return curves


def _converted(band: WrittenBand, unit: str) -> DrawnBand | None:
    # None: no band in this unit; a drawing without a band is better than none, and the scheduler refuses such a file
    found = []
    for bound, unbounded in ((band.low, -math.inf), (band.high, math.inf)):
        try:
            found.append(unbounded if bound is None else si(bound, unit))
        except AfspmError:
            return None
    low, high = found
    return DrawnBand(band.condition, low, high) if low < high else None
