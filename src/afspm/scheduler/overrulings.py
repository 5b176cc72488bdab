"""What components state for their measurements, and which values take the place of it.

A person who turns a gain down because the tip is in trouble, and a component that has found a gain, are right, and the
file is not. Their value takes the place of the one that a plan states, until the plan ends, or a person wants the file.

| event | for |
| --- | --- |
| in AUTOMATED a look finds neither the lent value nor its base | the lender, and who states the same value |
| a person beside the component in control sets a lent parameter | the same |
| who clears a problem has set another value than the base | the component whose measurement was found bad |
| a person keeps what was set in MANUAL | each component that states another value |
| the same parameter is decided again | as the newer value; at the stated value: for none |

A point of a sweep is never overruled. A value of a program or agent is a base, and no more.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace, without
from afspm.model import Parameter
from afspm.model.requests import Overruling, amount_text
from afspm.scheduler.loans import equal

_NOTHING: Mapping[str, Parameter] = {}


@dataclass(frozen=True)
class PlanBook:
    """What each component states, and what takes the place of it.

    Attributes:
        stated: for each component, what it has stated last, by key of the loan.
        overruled: the values that take the place of stated ones, by lender and key.
        measured: the component whose measurement has begun last, without solvers of problems; empty: none. Not saved.
        bases: the bases of what it had stated for that measurement, by key. Not saved.
        found: what the solver at work has set outside of its measurements, by key. Not saved.
    """

    stated: Mapping[str, Mapping[str, Parameter]] = field(default_factory=dict)
    overruled: Mapping[str, Mapping[str, Overruling]] = field(default_factory=dict)
    measured: str = ""
    bases: Mapping[str, Parameter] = field(default_factory=dict)
    found: Mapping[str, Parameter] = field(default_factory=dict)

    @property
    def in_force(self) -> tuple[Overruling, ...]:
        return tuple(one for rules in self.overruled.values() for one in rules.values())

    def instead(self, lender: str, key: str, planned: Parameter) -> Parameter:
        """Return the value with which a component measures that states `planned`."""
        rule = self.overruled.get(lender, {}).get(key)
        return rule.value if rule is not None and equal(rule.planned, planned) else planned

    def stating(self, lender: str, planned: Mapping[str, Parameter], swept: Collection[str] = ()) -> PlanBook:
        """Return the book after a component has stated its settings, and swept those of the keys in `swept`."""
        before = self.stated.get(lender, _NOTHING)
        known = {key: one for key, one in {**before, **planned}.items() if key not in swept}
        return self if known == before else replace(self, stated={**self.stated, lender: known})

    def begun(self, lender: str, bases: Mapping[str, Parameter]) -> PlanBook:
        """Return the book when the measurement of a component that solves no problem begins."""
        if (lender, bases) == (self.measured, self.bases):
            return self
        return replace(self, measured=lender, bases=bases)

    def decided(self, key: str, value: Parameter, lender: str, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a person's decision, with a sentence for each component that it concerns.

        Args:
            lender: the component whose loan was in force.
            by: who decided, such as "by page:ada" or "at the microscope".
        """
        book, notes = self, list[str]()
        planned = self.stated.get(lender, _NOTHING).get(key)
        if planned is None:
            return self, notes
        for one, stated in self.stated.items():
            if key not in stated:
                continue
            if equal(stated[key], planned):
                book, note = book._overruling(Overruling(one, stated[key], value, by), key)
                notes += note
            else:
                theirs = book.instead(one, key, stated[key])
                notes.append(f"{one} still sets {theirs.name} {amount_text(theirs)}")
        return book, notes

    def finding(self, key: str, value: Parameter) -> PlanBook:
        """Return the book after the solver of a problem has set a parameter."""
        return replace(self, found={**self.found, key: value})

    def solved(self, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a solver has cleared its problem, with a sentence for each value that it has found."""
        book, notes = replace(self, found={}), list[str]()
        planned = self.stated.get(self.measured, _NOTHING)
        for key, value in self.found.items():
            base = self.bases.get(key)
            if base is None or key not in planned or equal(value, base):  # a value set and set back is no finding
                continue
            book, note = book._overruling(Overruling(self.measured, planned[key], value, f"by {by}"), key)
            notes += note
        return book, notes

    def unsolved(self) -> PlanBook:
        """Return the book when a solver loses control: what it has set is a base."""
        return replace(self, found={}) if self.found else self

    def left(self, by_hand: Mapping[str, Parameter], kind: str) -> tuple[Overruling, ...]:
        """Return what would overrule plans if what was set in MANUAL were kept.

        Args:
            by_hand: the values set in MANUAL, by name.
            kind: the present kind of curve.
        """
        return tuple(
            Overruling(one, planned, by_hand[planned.name], "", is_asked=True)
            for one, stated in self.stated.items()
            for key, planned in stated.items()
            if planned.name in by_hand and _kind_in(key) in ("", kind)
            if not equal(by_hand[planned.name], self.instead(one, key, planned))
        )

    def keeping(self, left: Iterable[Overruling], kind: str, by: str) -> tuple[PlanBook, list[str]]:
        """Return the book after a person has kept what was set in MANUAL, with a sentence for each value."""
        book, notes = self, list[str]()
        for one in left:
            keys = [key for key, known in self.stated[one.lender].items() if known == one.planned]
            key = next(key for key in keys if _kind_in(key) in ("", kind))
            book, note = book._overruling(replace(one, by=f"by {by}", is_asked=False), key)
            notes += note
        return book, notes

    def as_planned(self, parameters: Collection[str] = ()) -> PlanBook:
        """Return the book without what overrules; without parameters, without all of it."""
        rest = {
            lender: left
            for lender, rules in self.overruled.items()
            if (left := {key: one for key, one in rules.items() if parameters and one.planned.name not in parameters})
        }
        return replace(self, overruled=rest)

    def ended(self, lender: str) -> PlanBook:
        """Return the book after a plan has ended."""
        if lender not in self.stated and lender not in self.overruled:
            return self
        return replace(self, stated=without(self.stated, lender), overruled=without(self.overruled, lender))

    def _overruling(self, one: Overruling, key: str) -> tuple[PlanBook, list[str]]:
        rules = self.overruled.get(one.lender, {})
        if equal(one.value, one.planned):
            if key not in rules:
                return self, []
            rest = without(rules, key)
            overruled = {**self.overruled, one.lender: rest} if rest else without(self.overruled, one.lender)
            note = f"{one.lender} measures at {one.planned.name} {amount_text(one.planned)} again, as it states"
            return replace(self, overruled=overruled), [note]
        if rules.get(key) == one:
            return self, []
        return replace(self, overruled={**self.overruled, one.lender: {**rules, key: one}}), [one.text]


def _kind_in(key: str) -> str:
    return key.partition(" ")[2]
