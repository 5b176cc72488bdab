"""Variables of curves by what they measure: each maker has its own name for the force on the way back.

`spectrum.of("force, retrace")` gives values in SI, however the maker names and orders them. A height is positive away
from the sample. A maker may measure the way back into columns of its own, or into the same columns after the way there:
then the sweep is split where it turns (`turning_point`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from afspm.basics.errors import ConfigError

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
TIME: Final = "time"
VARIABLES: Final = (
    BIAS, HEIGHT, CURRENT, CONDUCTANCE, FORCE, "deflection", FREQUENCY_SHIFT, "amplitude", "phase", "excitation", TIME,
)  # fmt: skip
"""What the variables of curves measure; each is a role for the way there, and with `RETRACE` for the way back."""
_LEAST_TURN: Final = 0.5
"""Least share of the sweep's range that both ways have to cover: noise of a one-way sweep turns, too."""


@dataclass(frozen=True)
class VariableRoles:
    """The variables of a microscope's curves by their roles.

    Attributes:
        names: the microscope's names of each role; a curve has one of them at most.
        towards: of these, the heights that grow towards the sample.
    """

    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    towards: tuple[str, ...] = ()

    @classmethod
    def declared(cls, names: Mapping[str, Sequence[str]], towards: Sequence[str] = ()) -> VariableRoles:
        """Return the roles that a driver declares.

        Raises:
            ConfigError: there is no such role.
        """
        for role in names:
            if role.removesuffix(RETRACE) not in VARIABLES:
                hint = f"one of {', '.join(VARIABLES)}, or one of them with {RETRACE!r}"
                raise ConfigError(f"there is no role {role!r} of a variable", where="variables", hint=hint)
        return cls({role: tuple(those) for role, those in names.items()}, tuple(towards))

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

    def refuses(self, role: str) -> str:
        """Return why the microscope can't have a variable in its curves; empty if it may.

        Whether both ways are in one column is seen in the curves alone, so that the way back counts as there.

        Args:
            role: "conductance or current" needs one of the two.
        """
        wanted = role.split(" or ")
        if any(one in self.names or one.removesuffix(RETRACE) in self.names for one in wanted):
            return ""
        return f"its curves have no {role.replace(RETRACE, '')}"


FOUND_BY_NAME: Final = VariableRoles.declared(
    {
        BIAS: ("Bias calc", "Bias", "Bias-mon"),
        HEIGHT: ("Z rel", "Z", "Z-mon", "ZSnsr"),
        CURRENT: ("Current", "CurrentSim1", "Cur"),
        CURRENT + RETRACE: ("Current Retrace", "Current [bwd]"),
        CONDUCTANCE: ("dI/dV",),
        FORCE: ("Force",),
        FORCE + RETRACE: ("Force Retrace", "Force [bwd]"),
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
        swept: the values of the swept variable, point by point; NaN after a stop.
    """
    import numpy as np

    measured = swept[np.isfinite(swept)]
    if len(measured) < 4 or not (extent := float(np.ptp(measured))):
        return None
    low, high = int(np.argmin(measured)), int(np.argmax(measured))
    # the turn is the extreme that is inside; at the other the sweep begins, ends, or both
    for turn in (low, high):
        before, after = abs(measured[turn] - measured[0]), abs(measured[turn] - measured[-1])
        if 0 < turn < len(measured) - 1 and min(before, after) > _LEAST_TURN * extent:
            return turn + 1
    return None
