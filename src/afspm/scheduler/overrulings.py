"""What components state for their measurements, and which values take the place of it.

A person who turns a gain down because the tip is in trouble, and a component that has found a gain, are right, and the
file is not. Their value takes the place of the one that a plan states, until the plan ends, or a person wants the file.

| event | for |
| --- | --- |
| in AUTOMATED a look finds neither the lent value nor its base | the lender, and who states the same value |
| a person beside the component in control sets a lent parameter | the same |
| a person decides it again, lent or not | each whose value it takes the place of; at the stated one: none |
| who clears a problem has found a value for it | the component whose measurement was found bad |
| a person keeps what was set in MANUAL | each component that states another value |

A point of a sweep is never overruled. A value of a program or agent is a base, and no more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace, without
from afspm.model import Parameter
from afspm.model.requests import Overruling, amount_text
from afspm.scheduler.loans import equal

_MOST_STATED = 4  # values of one parameter, as of a survey with its zooms; a script may state any number


@dataclass(frozen=True)
class StatedValue:
    """A value that a component has stated, with the key of its loan."""

    key: str
    parameter: Parameter


@dataclass(frozen=True)
class Rule:
    """A value in the place of a stated one, with the key of its loan."""

    key: str
    overruling: Overruling


@dataclass(frozen=True)
class Found:
    """What a solver has set last, as it asked for it and as it was answered, and whether it had set others before."""

    asked: Parameter
    answered: Parameter
    has_others: bool = False


@dataclass(frozen=True)
class Begun:
    """The component whose measurement has begun, with the bases of what it had stated for it, by key."""

    lender: str
    bases: Mapping[str, Parameter] = field(default_factory=dict)


@dataclass(frozen=True)
class PlanBook:
    """What each component states, and what takes the place of it.

    Attributes:
        stated: for each component, its last values of each parameter, newest last.
        rules: for each component, the values in the place of those.
        begun: the last two measurements of components that solve no problem, newest last. Not saved.
        solver_states: the first statement of the solver at work, by key: the settings found bad. Not saved.
        found: what the solver at work has set outside of its measurements, by key. Not saved.
    """

    stated: Mapping[str, tuple[StatedValue, ...]] = field(default_factory=dict)
    rules: Mapping[str, tuple[Rule, ...]] = field(default_factory=dict)
    begun: tuple[Begun, ...] = ()
    solver_states: Mapping[str, Parameter] = field(default_factory=dict)
    found: Mapping[str, Found] = field(default_factory=dict)

    @property
    def saved(self) -> PlanBook:
        return PlanBook(self.stated, self.rules)

    @property
    def in_force(self) -> tuple[Overruling, ...]:
        return tuple(rule.overruling for rules in self.rules.values() for rule in rules)

    def instead(self, lender: str, key: str, planned: Parameter) -> Parameter:
        """Return the value with which a component measures that states `planned`."""
        rule = self._rule(lender, key, planned)
        return planned if rule is None else rule.overruling.value

    def stating(self, lender: str, planned: Mapping[str, Parameter], swept: Collection[str] = ()) -> PlanBook:
        """Return the book after a component has stated its settings, and swept those of the keys in `swept`."""
        before = self.stated.get(lender, ())
        known = [one for one in before if one.key not in swept]
        for key, parameter in planned.items():
            same = [one for one in known if one.key == key and equal(one.parameter, parameter)]
            others = [one for one in known if one not in same]
            of_key = [one for one in others if one.key == key]
            oldest = of_key[: max(0, len(of_key) - _MOST_STATED + 1)]
            known = [*(one for one in others if one not in oldest), StatedValue(key, parameter)]
        if tuple(known) == before:
            return self
        # a value stated no more, as by a script or after a resume with another file, is no plan
        rules = tuple(
            rule
            for rule in self.rules.get(lender, ())
            if any(one.key == rule.key and equal(one.parameter, rule.overruling.planned) for one in known)
        )
        return replace(self, stated={**self.stated, lender: tuple(known)})._with_rules(lender, rules)

    def beginning(self, lender: str, bases: Mapping[str, Parameter]) -> PlanBook:
        """Return the book when the measurement of a component that solves no problem begins."""
        return replace(self, begun=(*self.begun[-1:], Begun(lender, bases)))

    # --- a person ---

    def decided(self, key: str, value: Parameter, lender: str, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a person's decision about a lent value, with a sentence for each component concerned.

        Args:
            lender: the component whose loan was in force.
            by: who decided, such as "by page:ada" or "at the microscope".
        """
        book, notes = self, list[str]()
        planned = self._newest(lender, key)
        if planned is None:
            return self, notes
        for name, known in self.stated.items():
            of_key = [one.parameter for one in known if one.key == key]
            for one in of_key:
                if equal(one, planned):
                    book, note = book._overruling(Overruling(name, one, value, by), key)
                    notes += note
            if of_key and not any(equal(one, planned) for one in of_key):
                theirs = book.instead(name, key, of_key[-1])
                notes.append(f"{name} still sets {theirs.name} {amount_text(theirs)}")
        return book, notes

    def newer(self, key: str, value: Parameter, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a person's decision about a value that is not lent now, with sentences as `decided`."""
        book, notes = self, list[str]()
        for rules in self.rules.values():
            for rule in rules:
                if rule.key == key and not equal(rule.overruling.value, value):
                    book, note = book._overruling(replace(rule.overruling, value=value, by=by), key)
                    notes += note
        return book, notes

    def left(self, by_hand: Mapping[str, Parameter], kind: str) -> Iterator[tuple[StatedValue, Overruling]]:
        """Yield what would overrule plans if what was set in MANUAL were kept, with the value that is stated.

        Args:
            by_hand: the values set in MANUAL, by name.
            kind: the present kind of curve.
        """
        for lender, known in self.stated.items():
            for one in known:
                value = by_hand.get(one.parameter.name)
                theirs = self.instead(lender, one.key, one.parameter)
                if value is not None and one.key.partition(" ")[2] in ("", kind) and not equal(value, theirs):
                    yield one, Overruling(lender, theirs, value, "", is_asked=True)

    def keeping(self, left: Collection[tuple[StatedValue, Overruling]], by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a person has kept what was set in MANUAL, with a sentence for each value."""
        book, notes = self, list[str]()
        for stated, one in left:
            kept = replace(one, planned=stated.parameter, by=f"by {by}", is_asked=False)
            book, note = book._overruling(kept, stated.key)
            notes += note
        return book, notes

    def as_planned(self, parameters: Collection[str] = ()) -> PlanBook:
        """Return the book without what overrules; without parameters, without all of it."""
        rest = {
            lender: left
            for lender, rules in self.rules.items()
            if (left := tuple(one for one in rules if parameters and one.overruling.planned.name not in parameters))
        }
        return replace(self, rules=rest)

    # --- the solver of a problem ---

    def solving(self, stated: Mapping[str, Parameter]) -> PlanBook:
        """Return the book after the solver at work has stated settings: first the ones found bad."""
        return self if self.solver_states else replace(self, solver_states=stated)

    def finding(self, key: str, asked: Parameter, answered: Parameter) -> PlanBook:
        """Return the book after the solver at work has set a parameter."""
        before = self.found.get(key)
        has_others = before is not None and (before.has_others or not equal(before.asked, asked))
        return replace(self, found={**self.found, key: Found(asked, answered, has_others)})

    def solved(self, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a solver has cleared its problem, with a sentence for each value that it has found."""
        book, notes, bad = self.unsolved(), list[str](), self._found_bad()
        for key, found in self.found.items():
            planned = self._newest(bad.lender, key)
            base = bad.bases.get(key)
            if planned is None or base is None:
                continue
            # a value set and set back is no finding; a controller may round
            if found.has_others and (equal(found.asked, base) or equal(found.answered, base)):
                continue
            book, note = book._overruling(Overruling(bad.lender, planned, found.answered, f"by {by}"), key)
            notes += note
        return book, notes

    def unsolved(self) -> PlanBook:
        """Return the book when a solver loses control: what it has set is a base."""
        return replace(self, found={}, solver_states={}) if self.found or self.solver_states else self

    def _found_bad(self) -> Begun:
        # who judges a scan may do so while the next one runs: the solver states the settings of the bad one first
        candidates = {one.lender: one for one in self.begun}
        fitting = [one for one in candidates.values() if self._fits(one.lender)] if len(candidates) > 1 else None
        found = list(candidates.values()) if fitting is None else fitting
        return found[0] if len(found) == 1 else Begun("")

    def _fits(self, lender: str) -> bool:
        stated = {one.key: self.instead(lender, one.key, one.parameter) for one in self.stated.get(lender, ())}
        common = stated.keys() & self.solver_states.keys()
        return bool(common) and all(equal(stated[key], self.solver_states[key]) for key in common)

    # --- within ---

    def ended(self, lender: str) -> PlanBook:
        """Return the book after a plan has ended."""
        if lender not in self.stated:
            return self
        return replace(self, stated=without(self.stated, lender), rules=without(self.rules, lender))

    def _newest(self, lender: str, key: str) -> Parameter | None:
        return next((one.parameter for one in self.stated.get(lender, ())[::-1] if one.key == key), None)

    def _rule(self, lender: str, key: str, planned: Parameter) -> Rule | None:
        of_key = (rule for rule in self.rules.get(lender, ()) if rule.key == key)
        return next((rule for rule in of_key if equal(rule.overruling.planned, planned)), None)

    def _overruling(self, one: Overruling, key: str) -> tuple[PlanBook, list[str]]:
        before = self._rule(one.lender, key, one.planned)
        rest = tuple(rule for rule in self.rules.get(one.lender, ()) if rule is not before)
        if not equal(one.value, one.planned):
            return self._with_rules(one.lender, (*rest, Rule(key, one))), [one.text]
        if before is None:
            return self, []
        note = f"{one.lender} measures at {one.planned.name} {amount_text(one.planned)} again, as it states"
        return self._with_rules(one.lender, rest), [note]

    def _with_rules(self, lender: str, rules: tuple[Rule, ...]) -> PlanBook:
        if rules == self.rules.get(lender, ()):
            return self
        return replace(self, rules={**self.rules, lender: rules} if rules else without(self.rules, lender))
