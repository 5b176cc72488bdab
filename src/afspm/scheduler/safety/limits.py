"""Limits of an experiment: which parameters may be set, how far, how fast, where, and from which component."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Annotated, Any, ClassVar, get_type_hints

from afspm.basics.units import PositiveDuration
from afspm.model import Parameter, Region, names
from afspm.model.bias import BiasReference
from afspm.scheduler.safety import rule_language
from afspm.scheduler.safety.movers import MoverSettings
from afspm.scheduler.safety.rule_language import RuleTree

_KEYS = {"low": "min", "high": "max", "rate_per_s": "rate", "interval_s": "every"}
"""The keys in the experiment file of fields with another name."""


def limit_key(name: str) -> str:
    """Return the key in the experiment file of a field of `Limit` or `ExperimentLimits`."""
    return _KEYS.get(name, name)


@dataclass(frozen=True)
class Bound:
    """The mark of a field that bounds requests: a driver may set its default, which an experiment file may tighten.

    Attributes:
        is_within: whether a value (first argument) is at least as strict as another.
    """

    is_within: Callable[[Any, Any], bool]


@cache
def bounds(kind: type) -> Mapping[str, Bound]:
    """Return the fields of a dataclass that are bounds, by name."""
    hints = get_type_hints(kind, include_extras=True)
    marks = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {name: mark for name, metadata in marks.items() for mark in metadata if isinstance(mark, Bound)}


def _is_part(components: tuple[str, ...], allowed: tuple[str, ...]) -> bool:
    return set(components) <= set(allowed)


def _lies_in(region: Region, allowed: Region) -> bool:
    return all(allowed.contains((float(x), float(y))) for x, y in region.corners_m())


@dataclass(frozen=True)
class Limit:
    """A limit of one parameter or action. Without a key there is no such limit; an action has `every` and `only` alone.

    Attributes:
        low: the lowest value allowed.
        high: the highest value allowed.
        step: the largest change in one request.
        rate_per_s: the largest change per experiment time since the parameter last changed, such as `"1 V/s"`.
        interval_s: the least experiment time between two requests.
        only: the components that may set the parameter or start the action.
        unseen_sweeps: whether a curve may sweep the parameter though the microscope does not show how far.
        unit: of the values above (the rate: per second); None: SI for the base parameters.
        source: the place in the experiment file, e.g. "experiment.toml:42".
    """

    low: Annotated[float | None, Bound(operator.ge)] = None
    high: Annotated[float | None, Bound(operator.le)] = None
    step: Annotated[float | None, Bound(operator.le)] = None
    rate_per_s: Annotated[float | None, Bound(operator.le)] = None
    interval_s: Annotated[PositiveDuration | None, Bound(operator.ge)] = None
    only: Annotated[tuple[str, ...] | None, Bound(_is_part)] = None
    unseen_sweeps: bool = False
    unit: str | None = None
    source: str = "[limits]"

    __pydantic_config__: ClassVar[object] = {"alias_generator": limit_key}

    @property
    def bounds_changes(self) -> bool:
        """Whether a check needs the value in force."""
        return self.step is not None or self.rate_per_s is not None

    @property
    def has_range(self) -> bool:
        return self.low is not None or self.high is not None

    @property
    def is_of_a_number(self) -> bool:
        """Whether the parameter must be a number."""
        return self.bounds_changes or self.has_range

    def times(self, sign: float) -> Limit:
        """Return the limit of the quantity times 1 or -1."""
        if sign > 0:
            return self
        low, high = (None if end is None else 0.0 - end for end in (self.high, self.low))
        return replace(self, low=low, high=high)

    def narrowed(self, other: Limit) -> Limit:
        """Return the limit that holds if both hold, in the same unit."""
        found: dict[str, Any] = {}
        for name, bound in bounds(Limit).items():
            mine, theirs = getattr(self, name), getattr(other, name)
            found[name] = theirs if mine is None or (theirs is not None and bound.is_within(theirs, mine)) else mine
        if self.only is not None and other.only is not None:
            found["only"] = tuple(who for who in self.only if who in other.only)
        source = ", ".join(dict.fromkeys((self.source, other.source)))
        return replace(self, **found, unseen_sweeps=self.unseen_sweeps and other.unseen_sweeps, source=source)


@dataclass(frozen=True)
class ForbiddenState:
    """A rule that joins quantities: no request may lead into a state in which the rule holds.

    Attributes:
        rule: the rule in the language of `rule_language`.
        units: the SI unit of each quantity in the rule, by name; switches and states have none.
        source: the place in the experiment file.
        bias_sign: the factor of `tip-bias-voltage` in place of `sample-bias`.
    """

    rule: str
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = "[limits] forbid"
    bias_sign: float = 1.0

    @cached_property
    def tree(self) -> RuleTree:
        tree = rule_language.parse(self.rule)
        return rule_language.renamed(tree, names.BIAS_OF_SAMPLE, names.TIP_BIAS_VOLTAGE, self.bias_sign)

    @cached_property
    def names(self) -> frozenset[str]:
        """The quantities, switches and states in the rule."""
        return frozenset(name for atom in rule_language.atoms(self.tree) for name in atom.names)


@dataclass(frozen=True)
class RoleLimits:
    """Further limits of a component, of a person, or of an agent that acts through a component.

    Attributes:
        limits: ranges, and the region, which is in the coordinates of components.
        parameters_only: whether all other parameters are refused.
        actions: the allowed actions; None: all.
        per_hour: the largest number of uses within an hour of experiment time, by action.
        source: the place in the experiment file.
    """

    limits: ExperimentLimits
    parameters_only: bool = False
    actions: tuple[str, ...] | None = None
    per_hour: Mapping[str, int] = field(default_factory=dict)
    source: str = "[limits.roles]"


@dataclass(frozen=True)
class ExperimentLimits:
    """All limits of an experiment.

    Beside each `Bound` is a field for its place, `<bound>_source`.

    Attributes:
        parameters: the limits of parameters, by name.
        actions: the limits of actions, by name.
        region: the area allowed for scans (all corners) and the probe, in m, in tip coordinates. An action at a place
            outside is refused even if the place was set at the panel.
        region_source: the place in the experiment file where the region was set.
        most_pixels: the largest number of pixels of a scan.
        most_pixels_source: the place in the experiment file where that number was set.
        sets: for each action by name, the parameters that the microscope sets as that action.
        roles: further limits by name of a component, or of a person or agent: "agent", "agent:claude".
        forbid: the forbidden states, by name.
        bias: the reference of the bias, which decides the sign of `sample-bias`. No limit here has that name.
        movers: the stages and coarse motors.
    """

    parameters: Mapping[str, Limit] = field(default_factory=dict)
    actions: Mapping[str, Limit] = field(default_factory=dict)
    region: Annotated[Region | None, Bound(_lies_in)] = None
    region_source: str = "[limits] region"
    most_pixels: Annotated[int, Bound(operator.le)] = 8192 * 8192
    most_pixels_source: str = "[limits] most_pixels"
    sets: Mapping[str, tuple[Parameter, ...]] = field(default_factory=dict)
    roles: Mapping[str, RoleLimits] = field(default_factory=dict)
    forbid: Mapping[str, ForbiddenState] = field(default_factory=dict)
    bias: BiasReference = field(default_factory=BiasReference)
    movers: MoverSettings = field(default_factory=MoverSettings)

    @cached_property
    def fixed(self) -> ExperimentLimits:
        """The limits that can be checked before a run: without steps, rates, intervals and movers.

        These depend on the values in force when a request is sent, which only the scheduler knows.
        """
        fixed = {
            name: replace(one, step=None, rate_per_s=None, interval_s=None) for name, one in self.parameters.items()
        }
        actions = {name: replace(one, interval_s=None) for name, one in self.actions.items()}
        return replace(self, parameters=fixed, actions=actions, movers=MoverSettings())

    @cached_property
    def bounded(self) -> frozenset[str]:
        """The parameters whose checks need the value in force."""
        return frozenset(name for name, limit in self.parameters.items() if limit.bounds_changes)

    @cached_property
    def rated(self) -> frozenset[str]:
        """The parameters with a limited rate."""
        return frozenset(name for name, limit in self.parameters.items() if limit.rate_per_s is not None)

    @cached_property
    def counted(self) -> frozenset[str]:
        """The parameters and actions with a shortest interval between two uses."""
        both = {**self.parameters, **self.actions}
        return frozenset(name for name, limit in both.items() if limit.interval_s is not None)
