"""Forbidden states: rules that join quantities, decided on the state after a request.

A rule refuses a request after which the rule would hold, or could hold because a value that decides it is unknown.
Three requests are never refused: one that ends the forbidden state, one that moves away from it, and a stop or retract
(`NEVER_REFUSED`). A request moves away if it makes no comparison of the rule truer, and at least one less true. A rule
has only `and` and `or`, so such a request can't begin a forbidden state, for any unknown values. A request
that changes no value of a rule is not judged by it, unless it is an action: nothing begins in a forbidden state.
A request itself is a value, too: `changes(lab.stage-x)` is on while a request is judged that moves the stage.

The caller collects the values before the request (`PresentState`). One value may have several candidates: an instrument
on its way to a target counts at both ends, and a scan counts from its start, before its state is published.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from afspm.basics.formatting import quantity
from afspm.model import ControlRequest, Feedback, Parameter, Request, ScopeState, names
from afspm.model.instruments import SEPARATOR, instrument_of, is_of_instrument
from afspm.model.parameter_names import BASE_PARAMETERS
from afspm.scheduler.safety import rule_language
from afspm.scheduler.safety.limits import ExperimentLimits, ForbiddenState, Limit
from afspm.scheduler.safety.parameter_values import ParameterValueError, values_of
from afspm.scheduler.safety.rule_language import Known, RuleAtom, RuleComparison, Value

STATES: Final = tuple(state.name for state in ScopeState if state is not ScopeState.UNDEFINED)
"""The states of the microscope, as named in rules."""
STARTED: Final = {names.START_SCAN: ScopeState.SCANNING, names.START_SPEC: ScopeState.SPEC}
"""The state that an action leads to."""
NEVER_REFUSED: Final = frozenset({names.STOP_SCAN, names.STOP_SPEC, names.RETRACT})
_WORDS: Final = {
    **dict.fromkeys((*names.ON_WORDS, "1.0"), True),
    **dict.fromkeys((*names.OFF_WORDS, "0.0"), False),
}
_BUSY: Final = f"{SEPARATOR}busy"
_MOST_COMBINATIONS = 4096  # of candidates; beyond, a rule counts as unknown, since the scheduler must not stand still


@dataclass(frozen=True)
class PresentState:
    """The state before a request.

    Attributes:
        values: the candidates for the value of each quantity, switch and state, by name.
        unknown: the reason for each value that is unknown, by name.
    """

    values: Mapping[str, tuple[Parameter, ...]] = field(default_factory=dict)
    unknown: Mapping[str, str] = field(default_factory=dict)


def in_states(states: Collection[ScopeState]) -> dict[str, tuple[Parameter, ...]]:
    """Return the candidates of each state's name for a microscope in one of several states."""
    return {
        name: tuple({Parameter(name, "true" if state.name == name else "false"): None for state in states})
        for name in STATES
    }


def changed_by(limits: ExperimentLimits, request: Request) -> dict[str, Parameter]:
    """Return the parameters and states that a request changes, by name; a malformed message changes nothing."""
    changed = dict[str, Parameter]()
    subjects: Collection[object] = (request.subject,)
    if request.kind == ControlRequest.ACTION:
        subjects = limits.sets.get(str(request.subject), ())
        if (state := STARTED.get(str(request.subject))) is not None:
            changed.update({name: value for name, (value,) in in_states([state]).items()})
    for subject in subjects:
        changed.update(values_in(subject))
    acts = [name for name in changed if name not in STATES]
    acts += [str(request.subject)] if request.kind == ControlRequest.ACTION else []
    switches = [*map(rule_language.change_of, acts), *(f"{name}{_BUSY}" for name in changed if is_of_instrument(name))]
    changed.update({switch: Parameter(switch, "true") for switch in switches})
    return changed


def values_in(subject: object) -> dict[str, Parameter]:
    """Return the parameters in a request or message, by name; none if it is malformed or reads a parameter."""
    if isinstance(subject, Parameter):
        return {} if subject.value is None else {subject.name: subject}
    values = dict[str, Parameter]()
    if isinstance(subject, Feedback) and subject.on is not None:
        values[names.FEEDBACK_ON] = Parameter(names.FEEDBACK_ON, "true" if subject.on else "false")
    try:
        for name, number in values_of(subject, {}):
            if number is not None:
                values[name] = Parameter(name, repr(number), BASE_PARAMETERS.get(name) or None)
    except ParameterValueError:  # `LimitChecker.check` refuses it
        return {}
    return values


def judging(limits: ExperimentLimits, request: Request) -> list[ForbiddenState]:
    """Return the rules that judge a request: all for an action, else those with a value that the request changes."""
    is_action = request.kind == ControlRequest.ACTION
    if not limits.forbid or (is_action and request.subject in NEVER_REFUSED):
        return []
    changed = changed_by(limits, request)
    return [rule for rule in limits.forbid.values() if is_action or rule.names & changed.keys()]


def to_read(rules: Collection[ForbiddenState]) -> list[str]:
    """Return the parameters of the microscope in rules; instruments report theirs, and states are published."""
    names_in_rules = {name for rule in rules for name in rule.names}
    known = {name for name in names_in_rules if name not in STATES and not rule_language.changed_name(name)}
    return sorted(name for name in known if not instrument_of(name) or name.startswith("x-"))


def refusal(limits: ExperimentLimits, request: Request, present: PresentState, *, certain: bool = False) -> str:
    """Return why forbidden states refuse a request; empty if none does.

    Args:
        certain: whether only a state that is certainly forbidden counts, as for a plan before its run.
    """
    rules = judging(limits, request)
    for changed in _changes(limits, request) if rules else ():
        for rule in rules:
            if why := _Decision.of(rule, request, changed, present).refusal(certain=certain):
                return why
    return ""


def _changes(limits: ExperimentLimits, request: Request) -> Iterator[dict[str, Parameter]]:
    # an action whose command sets the ends of a sweep sets one parameter twice: each of its values must be allowed
    changed = changed_by(limits, request)
    yield changed
    if request.kind == ControlRequest.ACTION:
        for subject in limits.sets.get(str(request.subject), ()):
            if changed.get(subject.name, subject) != subject:
                yield {**changed, subject.name: subject}


class PlanRehearsal:
    """Requests of a plan, one after the other, judged by the values that the plan itself has set so far."""

    def __init__(self, limits: ExperimentLimits) -> None:
        self._limits = limits
        self._known: dict[str, tuple[Parameter, ...]] = {}

    def refusal(self, request: Request) -> str:
        """Return why a request would certainly be refused; empty otherwise. A refused request changes nothing."""
        why = refusal(self._limits, request, PresentState(self._known), certain=True)
        if not why:
            changed = changed_by(self._limits, request).items()  # a scan ends by itself
            lasting = {name: (value,) for name, value in changed if name not in STATES and not name.endswith(_BUSY)}
            self._known.update(lasting)  # an instrument arrives
        return why


def now_forbidden(rule: ForbiddenState, present: PresentState) -> str:
    """Return the sentence that a state is forbidden; empty if it may be allowed."""
    known = {name: _value(rule, parameter) for name, (parameter, *_) in present.values.items() if name in rule.names}
    if not rule_language.holds(rule.tree, known):
        return ""
    return f"{' and '.join(_texts(rule, known, rule.names))} is a forbidden state: {rule.rule} ({rule.source})"


@dataclass(frozen=True)
class _Decision:
    """The judgement of one request by one rule.

    Attributes:
        settings: the values of the rule that the request changes; None: not a value of the right kind.
        before: each possible combination of the values before the request.
    """

    rule: ForbiddenState
    request: Request
    settings: Known
    before: list[Known]
    unknown: Mapping[str, str]

    @classmethod
    def of(
        cls, rule: ForbiddenState, request: Request, changed: Mapping[str, Parameter], present: PresentState
    ) -> _Decision:
        settings = {name: _value(rule, changed[name]) for name in rule.names & changed.keys()}
        before = list(_combinations(rule, present))
        return cls(rule, request, settings, before, present.unknown)

    def refusal(self, *, certain: bool) -> str:
        after = [{**known, **self.settings} for known in self.before]
        holds = [rule_language.holds(self.rule.tree, known) for known in after]
        if True in holds:
            return "" if self._moves_away() else self._sentence(after[holds.index(True)])
        if certain or None not in holds or self._moves_away():
            return ""
        return self._sentence_of_unknown(after[holds.index(None)])

    def _moves_away(self) -> bool:
        is_less = False
        for atom in rule_language.atoms(self.rule.tree):
            if not atom.names & self.settings.keys():
                continue
            steps = [(atom.excess(known), atom.excess({**known, **self.settings})) for known in self.before]
            if any(was is None or now is None or now > was for was, now in steps):
                return False
            # rounding at the border depends on the size of both sides
            if any(atom.holds({**known, **self.settings}) and not atom.holds(known) for known in self.before):
                return False
            is_less = is_less or all(was is not None and now is not None and now < was for was, now in steps)
        return is_less

    def _sentence(self, after: Known) -> str:
        is_action = self.request.kind == ControlRequest.ACTION
        acts = {rule_language.changed_name(name) for name in self.settings}
        changed = [name for name in self.settings if name not in STATES and name not in acts]
        what = [str(self.request.subject)] if is_action else _texts(self.rule, after, changed)
        others = _texts(self.rule, after, self.rule.names - self.settings.keys())
        meanwhile = f" while {' and '.join(others)}" if others else ""
        return (
            f"{' and '.join(what)} is forbidden{meanwhile}: {self.rule.rule} ({self.rule.source}){self._advice(after)}"
        )

    def _advice(self, after: Known) -> str:
        # a comparison whose end alone ends the forbidden state
        for atom in rule_language.atoms(self.rule.tree):
            if atom.names & self.settings.keys() or not atom.holds(after):
                continue
            if rule_language.holds(self.rule.tree, after, [atom]) is False and (cure := _cure(atom)):
                return f"; first {cure}"
        return ""

    def _sentence_of_unknown(self, after: Known) -> str:
        needed = [name for name in sorted(self.rule.names) if after.get(name) is None]
        reasons = [f"{name}: {self.unknown.get(name) or 'not a value of the right kind'}" for name in needed]
        what = (
            str(self.request.subject)
            if self.request.kind == ControlRequest.ACTION
            else " and ".join(sorted(self.settings))
        )
        return (
            f"{what} can't be checked against the forbidden state {self.rule.rule} ({self.rule.source}), since a value"
            f" is unknown: {'; '.join(reasons)}"
        )


def _combinations(rule: ForbiddenState, present: PresentState) -> Iterator[Known]:
    candidates = {
        name: (False,)
        if rule_language.changed_name(name)
        else tuple(_value(rule, parameter) for parameter in present.values.get(name, ())) or (None,)
        for name in sorted(rule.names)
    }
    if math.prod(map(len, candidates.values())) > _MOST_COMBINATIONS:
        yield {}
        return
    for values in itertools.product(*candidates.values()):
        yield dict(zip(candidates, values, strict=True))


def _value(rule: ForbiddenState, given: Parameter) -> Value | None:
    if given.name not in rule.units:
        return _WORDS.get((given.value or "").strip().lower())
    try:
        quantities = values_of(given, {given.name: Limit(unit=rule.units[given.name])})
    except ParameterValueError:
        return None
    return next((quantity.number for quantity in quantities), None)


def _texts(rule: ForbiddenState, known: Known, wanted: Collection[str]) -> list[str]:
    texts = []
    for name in sorted(wanted):
        value = known.get(name)
        if value is None:
            continue
        if name in rule.units:
            texts.append(f"{name} = {quantity(float(value), rule.units[name], 6)}")
        elif changed := rule_language.changed_name(name):
            texts.append(f"a change of {changed}")
        elif name in STATES:
            texts.append(f"the microscope is {'' if value else 'not '}{name}")
        else:
            texts.append(f"{name} = {'true' if value else 'false'}")
    return texts


def _cure(atom: RuleAtom) -> str:
    if not isinstance(atom, RuleComparison):
        if atom.name == names.ENGAGED and atom.on:
            return f"withdraw the tip ({names.RETRACT})"
        if atom.name.endswith(_BUSY) and atom.on:
            return f"wait until {atom.name.removesuffix(_BUSY)} has arrived"
        if atom.name in STATES:
            return f"wait until the microscope is {'not ' if atom.on else ''}{atom.name}"
        return f"set {atom.name} to {'false' if atom.on else 'true'}"
    low, high = (atom.left, atom.right) if atom.sign[0] == "<" else (atom.right, atom.left)
    strict = atom.sign[1:] == ""
    if not high.name:
        return f"bring {low} {'to at least' if strict else 'above'} {high}"
    return f"bring {high} {'to at most' if strict else 'below'} {low}"
