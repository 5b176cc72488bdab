"""The budget of a night for tip repairs: bounds on the treatments of all repairs together, and their account."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

from afspm.basics.errors import ConfigError
from afspm.components.tip_treatments import Crash, Treatment
from afspm.model.snapshot import from_plain, to_plain
from afspm.storage.memory import Memory

_ROUNDING = 1e-9  # relative: five crashes of 4 nm fit into 20 nm

# names in the experiment file
_SETTINGS = {"pulses": "night_pulses", "depth_m": "night_depth", "area_m2": "night_places", "time_s": "night_time"}


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
            raise ConfigError("a budget can't be negative", where=_SETTINGS[negative[0]])

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


class RepairAccount:
    """The cost of all repairs of a night, in the memory of a component, so that the budget holds over restarts.

    The caller saves the memory. A step is a treatment with its test scans.

    Args:
        spacing_m: the distance between the places of two treatments.
    """

    def __init__(self, budget: RepairBudget, spacing_m: float, memory: Memory) -> None:
        self._budget, self._spacing_m, self._memory = budget, spacing_m, memory
        self._step_tenure = -1

    @property
    def spent(self) -> RepairCost:
        return from_plain(RepairCost, self._memory["spent"]) if "spent" in self._memory else RepairCost()

    @property
    def step_s(self) -> float:
        """The longest time of a step, expected or measured."""
        return float(self._memory.get("longest_step_s", 0.0))

    def expect_step(self, lasts_s: float) -> None:
        self._memory["longest_step_s"] = max(self.step_s, lasts_s)

    def affordable(self, treatments: Sequence[Treatment]) -> tuple[Treatment, ...]:
        """Return the treatments that fit into the rest of the budget."""
        return self._budget.affordable(treatments, self.spent, self._spacing_m, self.step_s)

    def why_over(self, treatment: Treatment) -> str:
        cost = self.spent.plus(cost_of(treatment, self._spacing_m)).after(self.step_s)
        over = [_SETTINGS[name] for name in self._budget.exceeded_by(cost)]
        return f"the budget of the night is spent: a {treatment} does not fit into the rest of {' and '.join(over)}"

    def charge(self, treatment: Treatment, tenure: int) -> None:
        """Charge a treatment before it is attempted; after a kill it counts as done.

        Args:
            tenure: number of the present tenure of control.
        """
        self._keep(self.spent.plus(cost_of(treatment, self._spacing_m)))
        self._step_tenure = tenure

    def refund(self, before: RepairCost) -> None:
        """Charge the time only for a treatment that could not be done.

        Args:
            before: the cost before the charge.
        """
        self._keep(replace(before, time_s=self.spent.time_s))

    def spend_time(self, now_s: float, *, ends: bool = False) -> None:
        """Charge the time since the last call; a repair goes on until a call with `ends`.

        A repair that a kill interrupts goes on in the memory, so the time until the restart counts, too.
        """
        since_s = self._memory.get("repairing_since_s")
        if since_s is not None:
            self._keep(self.spent.after(now_s - since_s))
        if ends:
            self._memory.pop("repairing_since_s", None)
        else:
            self._memory["repairing_since_s"] = now_s

    def end_step(self, now_s: float, tenure: int) -> None:
        """Charge the time of a step, and measure it, unless a person had control meanwhile."""
        if self._step_tenure == tenure:
            self.expect_step(now_s - float(self._memory["repairing_since_s"]))
        self.spend_time(now_s)

    def _keep(self, cost: RepairCost) -> None:
        self._memory["spent"] = to_plain(cost)
