"""The budget of a night for tip repairs: bounds on the treatments of all repairs together. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from afspm.basics.errors import ConfigError
from afspm.components.tip_treatments import Crash, Treatment

_ROUNDING = 1e-9  # relative: five crashes of 4 nm fit into 20 nm


@dataclass(frozen=True)
class RepairCost:
    """The cost of past repairs, or of one treatment.

    Attributes:
        pulses: the number of pulses.
        depth_m: sum of the depths of crashes.
        area_m2: total area of the treated places; each place counts as a square with side `place_spacing`.
        time_s: the time of repairs, from gaining control to releasing it.
    """

    pulses: int = 0
    depth_m: float = 0.0
    area_m2: float = 0.0
    time_s: float = 0.0

    def plus(self, other: RepairCost) -> RepairCost:
        return RepairCost(*(getattr(self, one.name) + getattr(other, one.name) for one in fields(self)))

    def after(self, time_s: float) -> RepairCost:
        return replace(self, time_s=self.time_s + max(0.0, time_s))


def cost_of(treatment: Treatment, spacing_m: float) -> RepairCost:
    """Return the cost of a treatment, without its time."""
    if isinstance(treatment, Crash):
        return RepairCost(depth_m=treatment.depth_m, area_m2=spacing_m**2)
    return RepairCost(pulses=1, area_m2=spacing_m**2)


@dataclass(frozen=True)
class RepairBudget:
    """The largest cost allowed; None: no bound. The attributes are as in `RepairCost`."""

    pulses: int | None = None
    depth_m: float | None = None
    area_m2: float | None = None
    time_s: float | None = None

    def __post_init__(self) -> None:
        negative = [one.name for one in fields(self) if (getattr(self, one.name) or 0.0) < 0.0]
        if negative:
            raise ConfigError(f"a budget can't be negative: {', '.join(negative)}")

    def exceeded_by(self, cost: RepairCost) -> tuple[str, ...]:
        """Return the names of the bounds that a cost exceeds."""
        bounds = ((one.name, getattr(self, one.name)) for one in fields(self))
        return tuple(
            name for name, most in bounds if most is not None and getattr(cost, name) > most * (1.0 + _ROUNDING)
        )

    def affordable(
        self, treatments: Sequence[Treatment], spent: RepairCost, spacing_m: float, step_s: float
    ) -> tuple[Treatment, ...]:
        """Return the treatments that fit into the rest of the budget; each takes `step_s` with its test scans."""
        return tuple(
            one for one in treatments if not self.exceeded_by(spent.plus(cost_of(one, spacing_m)).after(step_s))
        )
