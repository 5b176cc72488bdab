"""Variables of curves by what they measure: each maker has its own name for the force on the way back.

`spectrum.of("force, retrace")` gives values in SI, however the maker names and orders them. A height is positive away
from the sample. A maker may measure the way back into columns of its own, or into the same columns after the way there:
then the sweep is split where it turns (`turning_point`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from afspm.basics.errors import ConfigError, NoSuchItem
from afspm.basics.plain_data import Plain, PlainMapping
from afspm.model.caption import SPRING_CONSTANT

if TYPE_CHECKING:
    from afspm.model.arrays import Array

RETRACE: Final = ", retrace"
"""End of the role of what was measured on the way back."""
HEIGHT: Final = "height"
CURRENT: Final = "current"
FREQUENCY_SHIFT: Final = "frequency shift"
BIAS: Final = "bias"
CONDUCTANCE: Final = "conductance"
FORCE: Final = "force"
DEFLECTION: Final = "deflection"
TIME: Final = "time"
VARIABLES: Final = (
    BIAS, HEIGHT, CURRENT, CONDUCTANCE, FORCE, DEFLECTION, FREQUENCY_SHIFT, "amplitude", "phase", "excitation", TIME,
)  # fmt: skip
"""What the variables of curves measure; each is a role for the way there, and with `RETRACE` for the way back."""
_LEAST_TURN: Final = 0.05
"""Least return of a sweep, as a share of its range: noise of a one-way sweep turns, too."""


@dataclass(frozen=True)
class VariableRoles:
    """The variables of a microscope's curves by their roles.

    Attributes:
        names: the microscope's names of each role; a curve has one of them at most.
        towards: of these, the heights that grow towards the sample.
        states: what each curve's file states of the cantilever: `SPRING_CONSTANT`, `SENSITIVITY`.
    """

    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    towards: tuple[str, ...] = ()
    states: tuple[str, ...] = ()

    @classmethod
    def declared(
        cls, names: Mapping[str, Sequence[str]], towards: Sequence[str] = (), states: Sequence[str] = ()
    ) -> VariableRoles:
        """Return the roles that a driver declares.

        Raises:
            ConfigError: there is no such role.
        """
        for role in names:
            if role.removesuffix(RETRACE) not in VARIABLES:
                hint = f"one of {', '.join(VARIABLES)}, or one of them with {RETRACE!r}"
                raise ConfigError(f"there is no role {role!r} of a variable", where="variables", hint=hint)
        return cls({role: tuple(those) for role, those in names.items()}, tuple(towards), tuple(states))

    def changed(self, given: Mapping[str, tuple[str, ...]]) -> VariableRoles:
        """Return the roles, with the experiment file's names before the driver's: scans may share a role."""
        names = {role: (*those, *self.names.get(role, ())) for role, those in given.items()}
        return replace(self, names={**self.names, **names})

    def column(self, role: str, present: Sequence[str]) -> str | None:
        """Return the name of the variable with this role among those of a curve; None without one."""
        return next((name for name in self.names.get(role, ()) if name in present), None)

    def roles_of(self, present: Sequence[str]) -> list[str]:
        """Return the role of each variable of a curve; "" for one without a role."""
        found = {self.column(role, present): role for role in self.names}
        return [found.get(name, "") for name in present]

    def listed(self, present: Sequence[str]) -> list[Plain]:
        """Return role and direction of each variable of a curve, for a file; `from_listed` reads them."""
        roles = self.roles_of(present)
        return [{"role": role, "towards": name in self.towards} for name, role in zip(present, roles, strict=True)]

    @classmethod
    def from_listed(cls, present: Sequence[str], listed: Sequence[PlainMapping]) -> VariableRoles | None:
        """Return the roles of a curve in a file; None if it is of a version that stored none."""
        if len(listed) != len(present) or not all("role" in one for one in listed):
            return None
        names = {one["role"]: (name,) for name, one in zip(present, listed, strict=True) if one["role"]}
        return cls(names, tuple(name for name, one in zip(present, listed, strict=True) if one["towards"]))

    def refuses(self, *roles: str, read: Collection[str] = ()) -> str:
        """Return why the microscope can't have a variable with one of these roles in its curves; empty if it may.

        Whether both ways are in one column is seen in the curves alone, so that the way back counts as there. A force
        follows from the deflection with a known spring constant.

        Args:
            read: the microscope's parameters, which are read for each curve.
        """
        quantities = [role.removesuffix(RETRACE) for role in roles]
        if not self.names.keys().isdisjoint((*roles, *quantities)):
            return ""
        why = f"its curves have no {' or '.join(quantities)}"
        if FORCE not in quantities:
            return why
        lacking = [] if {DEFLECTION, DEFLECTION + RETRACE} & self.names.keys() else [DEFLECTION]
        lacking += [] if SPRING_CONSTANT in {*self.states, *read} else [f"spring constant ({SPRING_CONSTANT}, in N/m)"]
        return f"{why}, and no {' and no '.join(lacking)} to derive it from" if lacking else ""


FOUND_BY_NAME: Final = VariableRoles.declared(
    {
        BIAS: ("Bias calc", "Bias", "Bias-mon"),
        HEIGHT: ("Z rel", "Z", "Z-mon", "ZSnsr"),
        CURRENT: ("Current", "CurrentSim1", "Cur", "Current [AVG]"),
        CURRENT + RETRACE: ("Current Retrace", "Current [bwd]", "Current [AVG] [bwd]"),
        CONDUCTANCE: ("dI/dV",),
        FORCE: ("Force",),
        FORCE + RETRACE: ("Force Retrace", "Force [bwd]"),
        FREQUENCY_SHIFT: ("Frequency Shift", "OC M1 Freq. Shift", "Frequency Shift [AVG]"),
        FREQUENCY_SHIFT + RETRACE: (
            "Frequency Shift Retrace",
            "OC M1 Freq. Shift [bwd]",
            "Frequency Shift [AVG] [bwd]",
        ),
        "amplitude": ("Amplitude", "Amplitude [AVG]"),
        "amplitude" + RETRACE: ("Amplitude [bwd]", "Amplitude [AVG] [bwd]"),
        "deflection": ("Deflection", "Defl"),
        "deflection" + RETRACE: ("Deflection Retrace", "Deflection [bwd]"),
        TIME: ("Time",),
    },
    towards=("ZSnsr",),
)
"""For curves that were recorded before drivers declared roles, and in files read without a driver."""


def turning_point(swept: Array) -> int | None:
    """Return how many points a sweep has before it turns; None if it goes one way.

    Args:
        swept: the values of the swept variable, point by point; NaN after a stop. Where the way back is stored as a
            second run in the same direction, the jump back to its beginning is the turn.

    Raises:
        NoSuchItem: the sweep turns more than once, as a loop or noise does, or has no range.
    """
    import numpy as np

    points = np.flatnonzero(np.isfinite(swept))
    values = swept[points]
    extent = float(np.ptp(values)) if len(values) > 1 else 0.0
    if not extent:
        raise NoSuchItem("nothing is swept")
    turns = _reversals(values.tolist(), _LEAST_TURN * extent)
    if len(turns) == 2 and turns[1] == turns[0] + 1:  # a jump
        turns = turns[:1]
    if len(turns) > 1:
        raise NoSuchItem(f"the sweep turns {len(turns)} times", hint="take the columns by their names")
    return int(points[turns[0]]) + 1 if turns else None


def _reversals(values: list[float], least: float) -> list[int]:
    # the extremes after which the values return by more than `least`
    found: list[int] = []
    low = high = 0
    rises: bool | None = None
    for i, value in enumerate(values):
        low, high = (i if value < values[low] else low), (i if value > values[high] else high)
        if rises is not False and values[high] - value > least:
            found += [high] if rises else []
            rises, low = False, i
        elif rises is not True and value - values[low] > least:
            found += [low] if rises is False else []
            rises, high = True, i
        if rises:
            low = i
        elif rises is False:
            high = i
    return found
