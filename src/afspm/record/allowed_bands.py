"""The values that [conditions] allows, for tables and drawings; the scheduler enforces the conditions itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from afspm.basics.errors import AfspmError
from afspm.basics.toml import parse_toml
from afspm.basics.units import si
from afspm.model.parameter_names import START_SCAN, START_SPEC
from afspm.record.run_json import EXPERIMENT_FILE


@dataclass(frozen=True)
class WrittenBand:
    """The bounds of one parameter in a condition, as the experiment file has them; None: no bound.

    Attributes:
        within: the largest distance from the target.
        actions: the actions that the condition guards.
    """

    condition: str
    low: str | float | None = None
    high: str | float | None = None
    within: str | float | None = None
    actions: tuple[str, ...] = (START_SCAN, START_SPEC)

    def contains(self, value: float | None, target: float | None, unit: str) -> bool:
        """Return whether a value is inside; an unknown value, or a missing target, is not.

        A bound that can't be converted to `unit` bounds nothing: the scheduler has refused each measurement then.
        """
        if value is None:
            return False
        low, high, within = (number_in(bound, unit) for bound in (self.low, self.high, self.within))
        if (low is not None and value < low) or (high is not None and value > high):
            return False
        return within is None or (target is not None and abs(value - target) <= within)


AllowedBands = Mapping[str, tuple[WrittenBand, ...]]
"""The bands of each instrument parameter, by its name."""


def allowed_bands(folder: Path) -> AllowedBands:
    """Return the bands in the expanded experiment file of a run; empty without bands, or without a readable file."""
    try:
        document = parse_toml((folder / EXPERIMENT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    found: dict[str, tuple[WrittenBand, ...]] = {}
    conditions = document.get("conditions")
    for name, condition in conditions.items() if isinstance(conditions, dict) else ():
        actions = tuple(condition.get("while") or WrittenBand.actions) if isinstance(condition, dict) else ()
        for parameter, table in condition.items() if isinstance(condition, dict) else ():
            if isinstance(table, dict):
                band = WrittenBand(name, table.get("from"), table.get("to"), table.get("within"), actions)
                found[parameter] = (*found.get(parameter, ()), band)
    return found


def number_in(bound: str | float | None, unit: str) -> float | None:
    """Return a bound as a number in `unit`; None without a bound, or if it can't be converted."""
    try:
        return None if bound is None else si(bound, unit)
    except AfspmError:
        return None
