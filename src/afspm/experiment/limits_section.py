"""[limits]: bounds on parameters, actions and scan regions, and the components that may use them.

The limits are enforced by `scheduler.safety.limits`.

[limits]
region = { x = ["-5 um", "5 um"], y = ["-5 um", "5 um"] }
most_pixels = 4_000_000
forbid = ["abs(tip-bias-voltage) > 1 V and zctrl-setpoint > 100 pA"]

[limits.tip-bias-voltage]
min = "-3 V"
max = "3 V"
step = "0.5 V"
rate = "1 V/s"
only = ["tip_corrector"]

[limits.actions.x-crash]
only = ["tip_corrector"]
every = "10 min"

[limits.movers]
retraction = 40
COARSE_OUT = { direction = "away", steps = 20, total = 2000 }
COARSE_LEFT = { direction = "lateral", steps = 10, total = 500 }

[limits.roles.agent]
actions = ["start-scan", "start-spec"]
region = { x = ["-2 um", "2 um"], y = ["-2 um", "2 um"] }
parameters = { tip-bias-voltage = ["-1 V", "1 V"] }
per_hour = { start-scan = 30 }
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeGuard, get_args

import pydantic

from afspm.basics import Angle, Count
from afspm.basics.errors import AfspmError
from afspm.basics.plain_data import WholeNumber
from afspm.basics.units import Length, parse_quantity, require_unit, si, si_unit
from afspm.experiment.document import Document
from afspm.experiment.findings import nearest
from afspm.experiment.sections import Section, parse
from afspm.experiment.toml_lines import Table
from afspm.experiment.validation_messages import name_of, report
from afspm.model import Parameter, Region, ScopeState, component_of, names
from afspm.model.bias import BiasReference
from afspm.model.instruments import instrument_of, split
from afspm.scheduler import ExperimentLimits
from afspm.scheduler.safety import rule_language
from afspm.scheduler.safety.forbidden_states import NEVER_REFUSED, STATES
from afspm.scheduler.safety.limits import ForbiddenState, Limit, RoleLimits, bounds, limit_key
from afspm.scheduler.safety.movers import MEASURES, Direction, Mover, MoverSettings
from afspm.scheduler.safety.rule_language import RuleComparison, RuleError, RuleSwitch, RuleTree

if TYPE_CHECKING:
    from afspm.translator.driver_base import CoarseMove

Quantity = str | float
_QUANTITIES: Final = ("min", "max", "step", "rate")
_OF_ACTION: Final = ("only", "every")
_OF_PARAMETER: Final = (*_QUANTITIES, *_OF_ACTION, "unseen_sweeps")
Pair = tuple[Length, Length]
_FORBID: Final = ("limits", "forbid")
_EXAMPLE: Final = "abs(tip-bias-voltage) > 1 V and zctrl-setpoint > 100 pA"


class RegionSection(Section):
    """[limits] region: ranges in x and y, or a rectangle given by centre, size and angle."""

    x: Pair | None = None
    y: Pair | None = None
    center: Pair | None = None
    size: Pair | None = None
    angle: Angle = 0.0


class LimitsSection(Section):
    """Keys of [limits] that are not parameters: the bounds of `ExperimentLimits`, loosened defaults, or none."""

    region: RegionSection | None = None
    most_pixels: Count = ExperimentLimits.most_pixels
    loosen: tuple[str, ...] = ()
    none: bool = False


class RoleSection(Section):
    """A table of [limits.roles]: further limits of a component, or of a person or agent that uses the component."""

    region: RegionSection | None = None
    actions: tuple[str, ...] | None = None
    parameters: dict[str, tuple[Quantity, Quantity]] | None = None
    per_hour: dict[str, WholeNumber] | None = None


_SWEPT: Final = (
    *(names.TIP_BIAS_VOLTAGE, names.BIAS_OF_SAMPLE, *names.SPEC_ENDS, *names.SPEC_Z_ENDS),
    *(names.SPEC_Z_OFFSET, names.LOCK_IN_AMPLITUDE),
)
_OWN: Final = (*LimitsSection.model_fields, "actions", "roles", "forbid", "movers")
_DIRECTIONS: Final = get_args(Direction)
_NO_MOVERS: Final = (*names.EXTENSION_ACTIONS, *names.OF_HELD_Z_ACTIONS)
_OF_MOVER: Final = ("direction", "steps", "total")
_TYPES: Final = {
    **dict.fromkeys((names.FEEDBACK_ON, names.ENGAGED), "bool"),
    **dict.fromkeys((names.SPEC_KIND, names.SCAN_DIRECTION, names.CONTROLLER), "text"),
}
"""The types of the parameters of afspm that are no numbers."""


@dataclass(frozen=True)
class LimitsReader:
    """A reader of the section [limits] for a microscope's capabilities.

    Args:
        parameters: SI units of the known parameters, by generic name; None: depends on the operating mode.
        actions: known actions; None if they can't be known before the microscope runs.
        sets: parameters that an action sets, by the action's name.
        certain: whether `parameters` has all parameters, or only the base parameters and afspm's extensions.
        lacking: known parameters that the microscope does not have.
        instruments: parameters of each other instrument, whose units are known only when the instrument runs.
        types: "bool" or "text" for parameters that are no numbers.
        bias: the reference of the bias; limits on `sample-bias` become limits on `tip-bias-voltage`.
        coarse: the moves of actions that move the coarse motor, by the action's name.
    """

    document: Document
    components: Collection[str]
    parameters: Mapping[str, str | None]
    actions: frozenset[str] | None
    sets: Mapping[str, tuple[Parameter, ...]]
    certain: bool
    instruments: Mapping[str, Collection[str]] = field(default_factory=dict)
    types: Mapping[str, str] = field(default_factory=dict)
    lacking: frozenset[str] = frozenset()
    bias: BiasReference = field(default_factory=BiasReference)
    coarse: Mapping[str, CoarseMove] = field(default_factory=dict)

    @property
    def _known_actions(self) -> frozenset[str]:
        known = (*names.BASE_ACTIONS, *names.EXTENSION_ACTIONS, *names.OF_HELD_Z_ACTIONS)
        return frozenset(known) if self.actions is None else self.actions

    def read(self, table: Table) -> ExperimentLimits:
        """Return the limits; after errors, which are reported, entries may be missing or empty."""
        own = {key: value for key, value in table.items() if key in LimitsSection.model_fields}
        whole = parse(LimitsSection, "limits", own, self.document)
        parameters = {key: value for key, value in table.items() if key not in _OWN}
        actions = table.get("actions", {})
        if not isinstance(actions, Mapping):
            self.document.error("[limits] actions is not a table", "limits", "actions")
            actions = {}
        given = {name: limit for name, keys in parameters.items() if (limit := self._parameter(name, keys))}
        read = self._by_canonical_name(given, "limits")
        movers = self._movers(table.get("movers", {}), read)
        limits = ExperimentLimits(
            parameters=read,
            actions={name: limit for name, keys in actions.items() if (limit := self._action(name, keys))},
            **self._bounds(whole, table),
            sets={action: parameters for action, parameters in self.sets.items() if parameters},
            roles=self._roles(table.get("roles", {}), read),
            forbid={**self._rules_of(movers), **self._forbid(table.get("forbid", []))},
            bias=self.bias,
            movers=movers,
        )
        self._check_sizes(limits)
        return limits

    def _bounds(self, whole: LimitsSection, table: Table) -> dict[str, Any]:
        given: dict[str, Any] = {name: getattr(whole, limit_key(name)) for name in bounds(ExperimentLimits)}
        given = {name: self._region(one) if isinstance(one, RegionSection) else one for name, one in given.items()}
        keys = {name: key for name in given if (key := limit_key(name)) in table}
        places = {f"{name}_source": str(self.document.place("limits", key)) for name, key in keys.items()}
        return given | places

    @property
    def _known_parameters(self) -> list[str]:
        return [*self.parameters, *(parameter for parameters in self.instruments.values() for parameter in parameters)]

    def _refuses_alias(self) -> tuple[str, str]:
        # why nothing may be limited by the name `sample-bias`, and the remedy
        if self.bias.may_have_second:
            what = "sample-bias can't be limited where a second electrode has a voltage of its own (x-sample-bias)"
            return what, 'limit the difference: forbid = ["abs(tip-bias-voltage - x-sample-bias) > 3 V"]'
        what, _, hint = self.bias.unknown.partition("; ")
        return what, hint

    def _by_canonical_name(self, given: Mapping[str, Limit], *path: str) -> dict[str, Limit]:
        read = dict(given)
        alias, panel = read.pop(names.BIAS_OF_SAMPLE, None), read.get(names.TIP_BIAS_VOLTAGE)
        if alias is None:
            return read
        alias = alias.times(self.bias.sign)
        both = read[names.TIP_BIAS_VOLTAGE] = alias if panel is None else panel.narrowed(alias)
        if both.low is not None and both.high is not None and both.low > both.high:
            what = f"{name_of(path)}: no value is within the limits of both sample-bias and tip-bias-voltage"
            self.document.error(what, *path, hint="they are one setting: limit one of them")
        return read

    def _parameter(self, name: str, table: object) -> Limit | None:
        if name == names.BIAS_OF_SAMPLE and (refused := self._refuses_alias())[0]:
            self.document.error(f"[limits.{name}] {refused[0]}", "limits", name, hint=refused[1])
            return None
        known = self._known_parameters
        if name not in known and (self.certain or not name.startswith("x-")):
            is_action = name in self._known_actions
            near = nearest(name, [*known, *_OWN])
            hint = f"it is an action: [limits.actions.{name}]" if is_action else near
            self.document.error(f"[limits] there is no parameter {name!r}", "limits", name, hint=hint)
            return None
        path = ("limits", name)
        if name in self.lacking:
            what = f"[limits.{name}] bounds nothing: this microscope has no such parameter"
            self.document.warning(what, *path, hint="leave it out, or limit what the microscope has")
        fields = self._table(table, path, _OF_PARAMETER)
        if fields is None:
            return None
        unit = self._unit(name, fields, path)
        read = self._limit(fields, path, unit)
        if read.unseen_sweeps and name not in _SWEPT:
            hint = f"it is for {', '.join(_SWEPT)}"
            self.document.error(f"[limits.{name}] unseen_sweeps: no curve sweeps it", *path, "unseen_sweeps", hint=hint)
        for key, value in (("step", read.step), ("rate", read.rate_per_s)):
            if value is not None and value <= 0:
                self.document.error(f"[limits.{name}] {key} is not above zero", *path, key)
        if read.low is not None and read.high is not None:
            if read.low > read.high:
                what = f"[limits.{name}] min = {fields['min']!r} is above max = {fields['max']!r}"
                self.document.error(what, *path, "min", hint="nothing would be allowed")
            elif read.step is not None and read.step > read.high - read.low:
                self.document.warning(f"[limits.{name}] step is larger than the whole range", *path, "step")
        return read

    def _unit(self, name: str, given: Table, path: tuple[str, ...]) -> str | None:
        known = self.parameters.get(name)
        if known is not None or not any(key in given for key in _QUANTITIES):
            return known
        if instrument_of(name) in self.instruments:
            return self._unit_of_instrument(given, path)
        unit = _unit_given(given, si_unit)
        if unit is None:
            if name in names.BASE_PARAMETERS:
                what = f"[limits.{name}] has no unit, and the microscope's own unit is not known before it runs"
                self.document.error(what, *path, hint='give one, as in "500 pA"')
            return ""
        what = f"[limits.{name}] counts in {unit}, as the microscope's own unit is not known before it runs"
        hint = f"values without a unit are taken to be in {unit}: see that the translator means the same"
        self.document.warning(what, *path, hint=hint)
        return unit

    def _unit_of_instrument(self, given: Table, path: tuple[str, ...]) -> str:
        # as written: an instrument converts it, and refuses values without a unit
        unit = _unit_given(given, str)
        if unit is None:
            what = f"[{'.'.join(path)}] has no unit: if the instrument's parameter has one, each request is refused"
            self.document.warning(what, *path, hint='give the unit, as in "20 K"')
        return unit or ""

    def _action(self, name: str, table: object) -> Limit | None:
        path = ("limits", "actions", name)
        if name not in self._known_actions and (self.actions is not None or not name.startswith("x-")):
            hint = nearest(name, self._known_actions)
            self.document.error(f"[limits.actions] there is no action {name!r}", *path, hint=hint)
        given = self._table(table, path, _OF_ACTION)
        if given is not None and "every" in given:
            self._never_waits(name, *path, "every")
        return None if given is None else self._limit(given, path, None)

    def _never_waits(self, action: str, *path: str | int) -> None:
        if action in NEVER_REFUSED:
            what = f"{name_of(path)}: {action} makes the tip safe or stops a measurement, and never waits"
            self.document.error(what, *path, hint="leave it out")

    def _forbid(self, given: object) -> dict[str, ForbiddenState]:
        if isinstance(given, Mapping):
            rules = [(name, name, rule) for name, rule in given.items()]
        elif isinstance(given, list):
            rules = [(i, str(rule), rule) for i, rule in enumerate(given)]
        else:
            what = "[limits] forbid is neither a list of rules nor a table of named rules"
            self.document.error(what, *_FORBID, hint=f'e.g. ["{_EXAMPLE}"]')
            return {}
        states = {name: self._rule(key, rule) for key, name, rule in rules}
        return {name: state for name, state in states.items() if state is not None}

    def _rule(self, key: str | int, rule: object) -> ForbiddenState | None:
        path = (*_FORBID, key)
        if not isinstance(rule, str):
            self.document.error(f"[limits] forbid: {rule!r} is not a text", *path, hint=f'e.g. "{_EXAMPLE}"')
            return None
        try:
            tree = rule_language.parse(rule)
            alias = {names.BIAS_OF_SAMPLE, rule_language.change_of(names.BIAS_OF_SAMPLE)}
            if any(alias & one.names for one in rule_language.atoms(tree)) and (refused := self._refuses_alias())[0]:
                raise RuleError(refused[0], rule.index(names.BIAS_OF_SAMPLE), refused[1])
            state = ForbiddenState(rule, source=str(self.document.place(*path)), bias_sign=self.bias.sign)
            return replace(state, units=self._units_of(state.tree))
        except RuleError as error:
            at = self._place_in(rule, path, error.at)
            self.document.error(f"[limits] forbid, {at}: {error.what}", *path, hint=error.hint)
            return None

    def _place_in(self, rule: str, path: tuple[str | int, ...], at: int) -> str:
        place, column = self.document.place(*path), -1
        with contextlib.suppress(OSError, IndexError, UnicodeDecodeError):
            column = Path(place.file).read_text(encoding="utf-8-sig").splitlines()[place.line - 1].find(rule)
        # a rule with escapes, or over several lines, is not found in its line
        return f"character {at + 1} of the rule" if column < 0 else f"column {column + at + 1}"

    def _units_of(self, tree: RuleTree) -> dict[str, str]:
        units = dict[str, str]()
        for atom in rule_language.atoms(tree):
            if isinstance(atom, RuleComparison):
                self._compare(atom, units)
            elif changed := rule_language.changed_name(atom.name):
                self._check_change(atom, changed)
            elif atom.name not in STATES and (kind := self._type_of(atom.name, atom.at)) != "bool":
                if kind == "text":
                    raise RuleError(f"{atom.name} is a text, which no rule can judge", atom.at)
                hint = f"as in {atom.name} > 0; a name alone is a switch or a state: {', '.join(STATES)}"
                raise RuleError(f"{atom.name} is a number, and is compared with nothing", atom.at, hint)
        return units

    def _check_change(self, atom: RuleSwitch, name: str) -> None:
        if not atom.on:
            raise RuleError("a change can't be denied", atom.at, f"changes({name}) is off unless a request changes it")
        if name in NEVER_REFUSED:
            raise RuleError(f"{name} makes the tip safe or stops a measurement, and is never refused", atom.at)
        if name not in self._known_actions:
            self._type_of(name, atom.at)

    def _compare(self, atom: RuleComparison, units: dict[str, str]) -> None:
        terms = (atom.left, atom.right)
        for name, at in ((name, term.at) for term in terms for name in term.names):
            is_switch = name in STATES or rule_language.changed_name(name)
            kind = "bool" if is_switch else self._type_of(name, at)
            if kind == "text":
                raise RuleError(f"{name} is a text, which no rule can judge", at)
            if kind:
                raise RuleError(f"{name} is on or off, and can't be compared", at, f"write {name} or not {name} alone")
        known = {name: self.parameters.get(name) for term in terms for name in term.names}
        known_units = [term.unit for term in terms if not term.name] + [
            unit for unit in known.values() if unit is not None
        ]
        known_units += [units[name] for name in known if name in units]
        if not known_units:
            what = f"the units of {' and '.join(known)} are known only in the run"
            raise RuleError(what, atom.left.at, "compare each with a number and its unit")
        left, right = (known.get(term.name, term.unit) if term.name else term.unit for term in terms)
        left, right = (known_units[0] if unit is None else unit for unit in (left, right))
        if left != right:
            what = f"{atom.left} and {atom.right} have different units: {left or 'no unit'} and {right or 'no unit'}"
            raise RuleError(what, atom.left.at if atom.right.name else atom.right.at)
        for name, unit in known.items():
            if units.setdefault(name, left) != left or unit not in (None, left):
                raise RuleError(f"{name} is compared in {unit or units[name]} and in {left}", atom.left.at)

    def _type_of(self, name: str, at: int) -> str:
        # empty for a number
        known = self._known_parameters
        of_instrument, part = split(name)
        if part == "busy" and of_instrument in known:
            return "bool"
        if name in known or (not self.certain and name.startswith("x-")):
            return self.types.get(name, _TYPES.get(name, ""))
        hint = nearest(name, [*known, *STATES])
        raise RuleError(f"there is no parameter, instrument's parameter or state {name!r}", at, hint)

    def _movers(self, table: object, limits: Mapping[str, Limit]) -> MoverSettings:
        path = ("limits", "movers")
        if not isinstance(table, Mapping):
            self.document.error("[limits] movers is not a table", *path)
            return MoverSettings()
        given = {
            name: one
            for name, keys in table.items()
            if name != "retraction"
            if (one := self._mover(name, keys, limits))
        }
        retraction, is_lateral = table.get("retraction"), any(one.direction == "lateral" for one in given.values())
        if (retraction is not None or is_lateral) and not _is_count(retraction):
            what = "[limits.movers] retraction is the number of steps away from the sample before a lateral move"
            hint = "e.g. retraction = 40; the withdrawal by the piezo, 1 to 2 um, is too little"
            self.document.error(what, *path, hint=hint)
        if given and names.ENGAGED not in self._known_parameters and self.certain:
            what = f"[limits.movers] this microscope never shows whether its tip is withdrawn ({names.ENGAGED})"
            self.document.error(what, *path, hint="leave it out, and move by hand after `afspm pause`")
        approach = names.APPROACH if names.APPROACH in self._known_actions else names.ENGAGE
        source = str(self.document.place(*path, "retraction"))
        ways = {
            move.direction for name, move in self.coarse.items() if name in given and given[name].direction == "away"
        }
        if len(ways - {""}) > 1:
            what = f"[limits.movers] the movers away from the sample go in two directions: {', '.join(sorted(ways))}"
            self.document.error(what, *path, hint="one of them goes towards the sample: try it by hand")
        undeclared = tuple(sorted(one for one in self.coarse if one not in given))
        return MoverSettings(given, retraction if _is_count(retraction) else 0, approach, undeclared, source)

    def _mover(self, name: str, table: object, limits: Mapping[str, Limit]) -> Mover | None:
        path = ("limits", "movers", name)
        of_instrument = name in self._known_parameters and instrument_of(name)
        is_any = self.actions is None and not of_instrument  # of a translator that is a program of its own
        is_action = (is_any or name in self._known_actions) and name not in (*names.BASE_ACTIONS, *_NO_MOVERS)
        if not is_action and not of_instrument:
            hint = nearest(name, [*self._known_actions, *(one for some in self.instruments.values() for one in some)])
            self.document.error(
                f"[limits.movers] there is no action or instrument's parameter {name!r}", *path, hint=hint
            )
            return None
        fields = self._table(table, path, _OF_MOVER)
        if fields is None:
            return None
        direction: Any = fields.get("direction")
        steps, limit = fields.get("steps"), limits.get(name)
        if direction not in _DIRECTIONS or (not is_action and direction != "lateral"):
            hint = f"one of {', '.join(_DIRECTIONS)}" if is_action else 'a parameter can go both ways: "lateral"'
            self.document.error(f"[limits.movers.{name}] direction = {direction!r}", *path, "direction", hint=hint)
            return None
        if is_action != _is_count(steps) or (not is_action and steps is not None):
            hint = "steps = 20" if is_action else "leave it out: it is for the actions of a motor"
            self.document.error(f"[limits.movers.{name}] steps: the steps of one action", *path, hint=hint)
            return None
        move = self.coarse.get(name)
        if move is not None and move.is_lateral not in (None, direction == "lateral"):
            what = f"[limits.movers.{name}] direction = {direction!r}, and its command goes {move.direction}"
            self.document.error(what, *path, "direction", hint="write the direction of the command")
        if move is not None and move.steps not in (None, steps):
            what = f"[limits.movers.{name}] steps = {steps}, and its command makes {move.steps}"
            self.document.error(what, *path, "steps", hint=f"steps = {move.steps}")
        if not is_action and (limit is None or limit.step is None):
            what = f"[limits.movers.{name}] a stage needs a longest way of one request"
            self.document.error(what, *path, hint=f'write [limits."{name}"] step = "100 um"')
            return None
        unit = "" if is_action or limit is None else limit.unit or ""
        total = self._in(fields.get("total"), "total", unit, path)
        return None if total is None else Mover(direction, total, steps, unit, str(self.document.place(*path)))

    @staticmethod
    def _rules_of(movers: MoverSettings) -> dict[str, ForbiddenState]:
        rules = [(name, f"{rule_language.change_of(name)} and {names.ENGAGED}") for name in movers.movers]
        stages = [name for name, mover in movers.movers.items() if mover.steps is None]
        rules += [(one, f"{rule_language.change_of(one)} and {ScopeState.COARSE_MOTOR.name}") for one in stages]
        needs_rest = (*names.APPROACHES, names.FEEDBACK_ON, *sorted(MEASURES))
        rules += [(one, f"{rule_language.change_of(act)} and {one}.busy") for one in stages for act in needs_rest]
        return {rule: ForbiddenState(rule, source=movers.movers[name].source) for name, rule in rules}

    def _roles(self, table: object, limits: Mapping[str, Limit]) -> dict[str, RoleLimits]:
        if not isinstance(table, Mapping):
            self.document.error("[limits] roles is not a table", "limits", "roles")
            return {}
        return {name: self._role(name, role, limits) for name, role in table.items()}

    def _role(self, name: str, table: object, limits: Mapping[str, Limit]) -> RoleLimits:
        path = ("limits", "roles", name)
        if component_of(name) not in self.components:
            what, near = f"[limits.roles] there is no component {component_of(name)!r}", component_of(name)
            self.document.error(what, *path, hint=nearest(near, self.components))
        plain = dict(table) if isinstance(table, Mapping) else {}
        given = parse(RoleSection, ".".join(path), plain, self.document, path)
        pairs = (given.parameters or {}).items()
        ranges = {name: limit for name, pair in pairs if (limit := self._range(name, pair, path)) is not None}
        ranges = self._by_canonical_name(ranges, *path, "parameters")
        unseen = {name for name, limit in limits.items() if limit.unseen_sweeps}
        places: list[tuple[str, tuple[str | int, ...]]] = [
            *((action, ("actions", number)) for number, action in enumerate(given.actions or ())),
            *((action, ("per_hour", action)) for action in given.per_hour or ()),
        ]
        for action, place in places:
            if action not in self._known_actions and (self.actions is not None or not action.startswith("x-")):
                what = f"[{'.'.join(path)}] there is no action {action!r}"
                self.document.error(what, *path, *place, hint=nearest(action, self._known_actions))
        for action in given.per_hour or ():
            self._never_waits(action, *path, "per_hour", action)
        source = str(self.document.place(*path))
        return RoleLimits(
            ExperimentLimits(
                parameters={
                    parameter: replace(limit, unseen_sweeps=parameter in unseen) for parameter, limit in ranges.items()
                },
                region=None if given.region is None else self._region(given.region, path),
                region_source=source,
            ),
            given.parameters is not None,
            given.actions,
            given.per_hour or {},
            source,
        )

    def _range(self, name: str, pair: tuple[Quantity, Quantity], path: tuple[str, ...]) -> Limit | None:
        place = (*path, "parameters", name)
        if name == names.BIAS_OF_SAMPLE and (refused := self._refuses_alias())[0]:
            self.document.error(f"[{'.'.join(path)}] {refused[0]}", *place, hint=refused[1])
            return None
        if name not in (known := self._known_parameters):
            what = f"[{'.'.join(path)}] there is no parameter {name!r}"
            self.document.error(what, *place, hint=nearest(name, known))
            return None
        bounds = dict(zip(("min", "max"), pair, strict=True))
        if name in self.parameters:
            unit = self.parameters[name] or _unit_given(bounds, si_unit) or ""
        else:
            unit = self._unit_of_instrument(bounds, place)
        low, high = (self._in(value, key, unit, place) for key, value in bounds.items())
        if low is not None and high is not None and low > high:
            self.document.error(f"{name_of(place)}: the first value is above the second", *place)
        return Limit(low, high, unit=unit, source=str(self.document.place(*place)))

    def _table(self, table: object, path: tuple[str, ...], known: Collection[str]) -> Table | None:
        if not isinstance(table, Mapping):
            self.document.error(f"{name_of(path)} is a table of keys and values, not {table!r}", *path)
            return None
        unknown = [key for key in table if key not in known]
        for key in unknown:
            self.document.error(f"{name_of((*path, key))} is not a setting", *path, key, hint=nearest(key, known))
        return None if unknown else table

    def _limit(self, given: Table, path: tuple[str, ...], unit: str | None) -> Limit:
        plain = {key: self._in(value, key, unit, path) if key in _QUANTITIES else value for key, value in given.items()}
        try:
            read = pydantic.TypeAdapter(Limit).validate_python(plain)
        except pydantic.ValidationError as error:
            report(error, plain, path, self.document)
            read = Limit()
        if read.interval_s and not _has_unit(given["every"]):  # minutes may be meant
            what = f"[{'.'.join(path)}] every = {given['every']!r} has no unit, and counts in s"
            hint = f'write it as "{read.interval_s:g} s", or "{read.interval_s:g} min"'
            self.document.warning(what, *path, "every", hint=hint)
        for i, who in enumerate(read.only or ()):
            if who not in self.components:
                what = f"[{'.'.join(path)}] only: there is no component {who!r}"
                self.document.error(what, *path, "only", i, hint=nearest(who, self.components))
        return replace(read, unit=unit, source=str(self.document.place(*path)))

    def _in(self, value: object, key: str, unit: str | None, path: tuple[str, ...]) -> float | None:
        where = f"[{'.'.join(path)}] {key} = {value!r}"
        if isinstance(value, bool) or not isinstance(value, str | float | int):
            self.document.error(f"{where} is not a quantity", *path, key)
            return None
        try:
            number = _rate(value, unit or "") if key == "rate" else si(value, unit or "")
        except AfspmError as error:
            hint = f'a change in a time, as in "1 {unit or ""}/s"' if key == "rate" else error.hint
            self.document.error(f"{where}: {error.what}", *path, key, hint=hint)
            return None
        if not math.isfinite(number):
            self.document.error(f"{where} is not a finite number", *path, key)
            return None
        if unit == "s" and key != "rate" and number and not _has_unit(value):  # milliseconds may be meant
            what = f"{where} has no unit, and counts in s"
            self.document.warning(what, *path, key, hint=f'write it as "{number:g} s", or "{number:g} ms"')
        return number

    def _region(self, box: RegionSection, owner: tuple[str, ...] = ("limits",)) -> Region | None:
        path = (*owner, "region")
        match box.x, box.y, box.center, box.size:
            case (left, right), (low, high), None, None:
                center, size = ((left + right) / 2, (low + high) / 2), (right - left, high - low)
            case None, None, (_, _) as center, (_, _) as size:
                pass
            case _:
                self.document.error(f"{name_of(path)} needs either x and y, or center and size", *path)
                return None
        if min(size) <= 0:
            self.document.error(f"{name_of(path)} is empty", *path, hint="from the smaller to the larger value")
            return None
        return Region(center, size, box.angle)

    def _check_sizes(self, limits: ExperimentLimits) -> None:
        if limits.region is None:
            return
        longest_m = math.hypot(*limits.region.size_m)
        for name in (names.SCAN_SIZE_X, names.SCAN_SIZE_Y):
            limit = limits.parameters.get(name)
            if limit is not None and limit.low is not None and limit.low > longest_m:
                what = f"[limits.{name}] min does not fit into [limits] region"
                self.document.error(what, "limits", name, "min", hint="no scan would be allowed")


def _unit_given(given: Table, as_unit: Callable[[str], str]) -> str | None:
    for key in _QUANTITIES:
        if isinstance(value := given.get(key), str):
            with contextlib.suppress(AfspmError):  # reported when the value is read
                written = parse_quantity(value)[1]
                over, slash, _ = written.rpartition("/")
                if unit := as_unit(over if key == "rate" and slash else written):
                    return unit
    return None


def _is_count(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value > 0


def _has_unit(value: object) -> bool:
    return isinstance(value, str) and bool(parse_quantity(value)[1])


def _rate(value: Quantity, unit: str) -> float:
    if not isinstance(value, str):
        require_unit(value, unit)
        return float(value)
    number, given = parse_quantity(value)
    over, slash, under = given.rpartition("/")
    if not slash:
        return si(f"{number} {given}", f"{unit}/s" if unit else "1/s")
    return si(f"{number} {over}", unit) / si(f"1 {under}", "s")
