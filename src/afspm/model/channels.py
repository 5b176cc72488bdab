"""Channels by what they measure: a component asks for "height", and each maker has its own name for it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, TypeVar

from afspm.basics.errors import ConfigError
from afspm.model.scan import Scan, ScanLines
from afspm.model.spectrum import Spectrum
from afspm.model.variables import CURRENT, FOUND_BY_NAME, FREQUENCY_SHIFT, HEIGHT, RETRACE, VARIABLES, VariableRoles

HEIGHT_RETRACE: Final = HEIGHT + RETRACE
INTENSITY: Final = "intensity"
"""Role of the signal of a detector, where a beam scans instead of a tip."""
TOPOGRAPHY: Final = "topography"
"""Role of the channel that shows the sample: the height, or at constant height what `AT_CONSTANT_HEIGHT` names, or the
intensity of a microscope without a tip."""
QUANTITIES: Final = (
    HEIGHT, CURRENT, "amplitude", "phase", "deflection", FREQUENCY_SHIFT, "excitation", "friction", "potential",
    INTENSITY,
)  # fmt: skip
"""The measured quantities, each with a role for the trace, and one with `RETRACE` for the retrace."""
ROLES_APART: Final = "; "
"""Between the roles of a channel in an exported file."""
OTHER: Final = "other"
"""Under this name the experiment file lists channels without a role."""
AT_CONSTANT_HEIGHT: Final = (FREQUENCY_SHIFT, CURRENT)
"""Roles of the topography while the z feedback is off; the first that the microscope has counts."""
_NO_LENGTHS: Final = (CURRENT, "phase", FREQUENCY_SHIFT, "excitation", "potential", INTENSITY)
"""Quantities that no microscope records in metres; an amplitude, a deflection or a friction may be calibrated to it."""
ROLES: Final = (*QUANTITIES, *(quantity + RETRACE for quantity in QUANTITIES), TOPOGRAPHY)

Measured = TypeVar("Measured", bound=Scan | ScanLines)
Shown = TypeVar("Shown", bound=Scan | ScanLines | Spectrum)


@dataclass(frozen=True)
class NamesChannel:
    """Annotation of a setting with the role or the name of a channel, which `afspm check` compares."""


ChannelName = Annotated[str, NamesChannel()]
"""The type of a setting that names a channel: a role of `ROLES`, or a maker's own name.

Where a component needs heights, the type is `Annotated[ChannelName, HEIGHT]`: `afspm check` refuses a current there.
"""


@dataclass(frozen=True)
class ChannelRoles:
    """The channels of a microscope by their roles.

    Attributes:
        names: the microscope's names of each role. A scan has only one of them.
        others: names of channels without a role.
        variables: the variables of curves by their roles; None if the microscope does not say.
    """

    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    others: tuple[str, ...] = ()
    variables: VariableRoles | None = None

    @classmethod
    def declared(cls, names: Mapping[str, Sequence[str]], variables: VariableRoles | None = None) -> ChannelRoles:
        """Return the roles that a driver declares; under the name `OTHER` its channels without a role."""
        of_roles = {role: tuple(those) for role, those in names.items() if role != OTHER}
        return cls(of_roles, tuple(names.get(OTHER, ())), variables)

    def changed(self, given: Mapping[str, str | Sequence[str]]) -> ChannelRoles:
        """Return the roles, with the names of the experiment file in place of the driver's.

        Raises:
            ConfigError: there is no such role, or a name is not a text.
        """
        found = {role: (names,) if isinstance(names, str) else tuple(names) for role, names in given.items()}
        for role, names in found.items():
            if role == TOPOGRAPHY or role not in (*ROLES, OTHER, *VARIABLES, *(one + RETRACE for one in VARIABLES)):
                known = dict.fromkeys((*QUANTITIES, *VARIABLES, OTHER))
                hint = f"one of {', '.join(known)}, or one of them with {RETRACE!r}"
                raise ConfigError(f"there is no role {role!r} of a channel", where="channels", hint=hint)
            if not all(isinstance(name, str) and name for name in names):
                raise ConfigError(f"the name of the channel for {role!r} is {given[role]!r}", where="channels")
        of_roles = {**self.names, **{role: names for role, names in found.items() if role in ROLES}}
        of_curves = {role: names for role, names in found.items() if role.removesuffix(RETRACE) in VARIABLES}
        variables = (self.variables or FOUND_BY_NAME).changed(of_curves) if of_curves else self.variables
        return ChannelRoles(of_roles, (*self.others, *found.get(OTHER, ())), variables)

    def with_topography(self, *, feedback_on: bool | None) -> ChannelRoles:
        """Return the roles with the topography: at constant height, the height shows nothing."""
        wanted = AT_CONSTANT_HEIGHT if feedback_on is False else ()
        role = next((one for one in (*wanted, HEIGHT, INTENSITY) if one in self.names), None)
        return self if role is None else replace(self, names={**self.names, TOPOGRAPHY: self.names[role]})

    def of(self, channel: str) -> tuple[str, ...]:
        """Return the roles of a channel; empty without a role."""
        return tuple(role for role, names in self.names.items() if channel in names)

    def shown(self, measured: Shown) -> Shown:
        """Return a scan, or lines of one, with the roles of its channel; a spectrum with those of its variables."""
        if isinstance(measured, Spectrum):
            return measured if self.variables is None else replace(measured, declared_roles=self.variables)
        roles = self.of(measured.channel)
        return replace(measured, roles=roles) if roles else measured

    def topography_first(self, channels: Iterable[str]) -> tuple[str, ...]:
        """Return channels as they are shown: the topography first, the others in their order."""
        return tuple(sorted(channels, key=lambda channel: TOPOGRAPHY not in self.of(channel)))

    def refuses(self, channel: str) -> str:
        """Return why the microscope cannot have a channel, by its role or name; empty for one that it may have."""
        known = {*self.names, *self.all_names()}
        if not known.isdisjoint((HEIGHT, INTENSITY)):
            known.add(TOPOGRAPHY)
        if not channel or channel in known:
            return ""
        kind = "role" if channel in ROLES else "channel"
        return f"the microscope has no {kind} {channel!r}"

    def refuses_as_height(self, channel: str) -> str:
        """Return why a channel, by its role or name, can't be converted to metres; empty if it may be."""
        roles = (channel,) if channel in self.names else self.of(channel)
        quantities = [role.removesuffix(RETRACE) for role in roles]
        is_refused = bool(quantities) and all(quantity in _NO_LENGTHS for quantity in quantities)
        return f"{channel!r} is not a height: it measures the {quantities[0]}" if is_refused else ""

    def all_names(self) -> tuple[str, ...]:
        """Return the names of all channels, each once."""
        return tuple(dict.fromkeys(name for names in (*self.names.values(), self.others) for name in names))

    def described(self) -> str:
        """Return each role with its names, for an error message."""
        roles = [f"{role} ({' or '.join(names)})" for role, names in self.names.items()]
        return "; ".join((*roles, *self.others))


def both_ways(names: Mapping[str, Sequence[str]], trace: str, retrace: str) -> dict[str, tuple[str, ...]]:
    """Return the names of each quantity's trace and retrace, by role.

    Args:
        names: without the direction, by quantity or `OTHER`.
        trace, retrace: form of the names, with "{}" for the name without the direction.
    """
    ways = (("", trace), (RETRACE, retrace))
    found: dict[str, tuple[str, ...]] = {}
    for role, those in names.items():
        for end, way in ways:
            key = OTHER if role == OTHER else role + end
            found[key] = (*found.get(key, ()), *(way.format(name) for name in those))
    return found


def of_role(scans: Iterable[Measured], channel: str) -> Measured | None:
    """Return the first scan whose channel has this name, or else the first that has this role; None without one."""
    of_both = list(scans)
    by_name = (scan for scan in of_both if scan.channel == channel)
    return next(by_name, next((scan for scan in of_both if channel in scan.roles), None))
