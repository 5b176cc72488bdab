"""The book of loans: which settings are in force for one component's measurement, and what was in force before.

A measurement states its settings, such as its bias. The scheduler sets them right before it, as a loan: the value that
was in force, the base, is set back before a measurement that does not state that setting, and when its lender is done.
A value that a person or a request sets outside of a measurement is a decision: the loan is gone, and the value is the
base. Nothing is trusted that was not read at the same moment, since a person may turn any knob: `LoanBook.compared`.

| event | the book |
| --- | --- |
| LEND of a value, not in the book | entry, on disk before the value is sent |
| LEND of a value in the book | the base stays |
| LEND of a value that is in force | stated; entry if there is none; nothing is sent |
| the base can't be read; the parameter may not be lent | no entry: a decision |
| a measurement has begun, control changes, MANUAL, a restart | nothing is stated any more |
| a measurement or treatment that does not state it | gone, once the base is in force again |
| RETURN; its lender is given up or gone; a problem is solved by another; the end; FREE for long | over |
| a decision | gone |
| at the next look another value is in force than the lent one | gone: that value is the base, and it is logged |
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace, without
from afspm.basics.units import in_si
from afspm.model import Parameter, names
from afspm.model.requests import LoanInForce, LoansInForce, Setting

SETTLES = frozenset(
    (names.TIP_BIAS_VOLTAGE, names.SAMPLE_BIAS, names.ZCTRL_SETPOINT, names.ZCTRL_PGAIN, names.ZCTRL_IGAIN)
)
"""The parameters after whose change the feedback needs time."""
_NONE = LoansInForce()
_LOCK_IN = frozenset((names.LOCK_IN_AMPLITUDE, names.LOCK_IN_FREQUENCY))  # it modulates during scans, too
_LINE_RATE = 0.01  # relative: a new frame changes a speed behind which stands a line rate, by its rounding
_ROUNDED = 1e-6  # relative: a reading in single precision is the value that was set


@dataclass(frozen=True)
class Loan:
    """A setting that is in force for one component's measurements.

    Attributes:
        base: the value in force before, which is set back.
        value: the value in force, as the microscope answered it.
        kind: the kind of curve that the setting belongs to; empty for a setting of all measurements.
        before: the value in force before `value` was sent, until it is answered; None: it is.
        is_over: whether it is set back as soon as possible.
        is_unsure: whether others may have changed the value since it was lent.
        is_watched: whether the run was AUTOMATED and in contact since: another value is then a person's.
        why: why it could not be set back; empty: nothing is known against it.
    """

    base: Parameter
    value: Parameter
    lender: str
    kind: str = ""
    before: Parameter | None = None
    is_over: bool = False
    is_unsure: bool = False
    is_watched: bool = True
    why: str = ""

    @property
    def name(self) -> str:
        return self.base.name

    @property
    def in_force(self) -> LoanInForce:
        return LoanInForce(self.value, self.base, self.lender, self.is_unsure, self.why)

    @property
    def text(self) -> str:
        return self.in_force.text


@dataclass(frozen=True)
class LoanBook:
    """The loans by key, and what the holder's next measurement states.

    Attributes:
        stated: the values stated since the last measurement began or control changed, by key. Not saved.
        lent_last: the client of the last LEND.
        token: the session of its process; None: unknown. Not saved.
        is_broken: whether it may have stated something that is not known any more. Not saved.
        free_since_ns: the experiment time since which the microscope is free; None: it is not. Not saved.
        is_compared: whether the translator compares values by itself. Not saved.
        shown: what was published last; None: nothing since a restart. Not saved.
        again_s: the real time before which no return is tried again. Not saved.
    """

    loans: Mapping[str, Loan] = field(default_factory=dict)
    stated: Mapping[str, Parameter] = field(default_factory=dict)
    lent_last: str = ""
    token: str | None = None
    is_broken: bool = False
    free_since_ns: int | None = None
    is_compared: bool = True
    shown: LoansInForce | None = _NONE
    again_s: float = 0.0

    @classmethod
    def restored(cls, loans: Mapping[str, Loan], lent_last: str) -> LoanBook:
        """Return the book after a restart, which others may have used to act."""
        unwatched = {key: replace(loan, is_watched=False) for key, loan in loans.items()}
        return cls(unwatched, lent_last=lent_last, shown=None if lent_last else _NONE)

    @property
    def in_force(self) -> tuple[LoanInForce, ...]:
        """The loans for people: a value that is its own base looks like none."""
        return tuple(one.in_force for one in self.loans.values() if one.why or not equal(one.value, one.base))

    def of_kind(self, kind: str) -> Iterator[tuple[str, Loan]]:
        """Yield the loans whose value can be read now, with their keys."""
        return ((key, loan) for key, loan in self.loans.items() if loan.kind in ("", kind))

    def due(self, action: str, kind: str) -> list[str]:
        """Return the keys of the loans that a measurement or treatment has not stated, newest first.

        Args:
            kind: the present kind of curve.
        """
        found = [key for key, loan in self.of_kind(kind) if key not in self.stated and _matters(loan.name, action)]
        return found[::-1]

    def over(self) -> list[str]:
        """Return the keys of the loans to be set back as soon as possible, newest first."""
        return [key for key, loan in self.loans.items() if loan.is_over][::-1]

    def compared(self, settings: Mapping[str, Setting], kind: str) -> tuple[LoanBook, dict[str, Loan]]:
        """Return the book after a look at the values in force, with the loans, by key, whose value others have changed.

        Args:
            settings: the translator's answers by name: a loan is looked at if its lent value or base was asked for.
        """
        book, changed = self, dict[str, Loan]()
        for key, loan in self.of_kind(kind):
            if (found := settings.get(loan.name)) is None:
                continue
            there = next((one for one in (loan.value, loan.before) if one in found.known), None)
            if there is None and loan.name == names.SCAN_SPEED and equal(loan.value, found.parameter, _LINE_RATE):
                there = loan.value
            if there is not None:
                sure = replace(loan, value=there, before=None, is_unsure=False, is_watched=True)
                book = book if sure == loan else book._with(key, sure)
                continue
            book = replace(book, loans=without(book.loans, key))
            is_base = loan.name == names.SCAN_SPEED and equal(loan.base, found.parameter, _LINE_RATE)
            if loan.base not in found.known and not is_base:
                changed[key] = loan
        return book, changed

    def sending(self, key: str, now: Parameter, value: Parameter, lender: str, kind: str) -> LoanBook:
        """Return the book with a value that is about to be sent, or in force; the base of an earlier loan stays.

        Args:
            now: the value in force.
            lender: empty on the way back of a loan, whose lender stays.
        """
        known = self.loans.get(key)
        before = None if value == now else now
        if known is None:
            return self._with(key, Loan(now, value, lender, kind, before)) if lender else self
        loan = Loan(known.base, value, lender, kind, before) if lender else replace(known, value=value, before=before)
        return self if loan == known else self._with(key, loan)

    def stating(self, lender: str, token: str | None, stated: Mapping[str, Parameter]) -> LoanBook:
        return replace(self, stated=dict(stated), lent_last=lender, token=token, is_broken=False)

    def nothing_stated(self) -> LoanBook:
        """Return the book once a measurement has begun, or control has changed."""
        return replace(self, stated={}) if self.stated else self

    def broken(self) -> LoanBook:
        """Return the book after a restart, or a lost connection: a client may rely on what it has stated before."""
        return replace(self.nothing_stated().unsure(is_watched=False), is_broken=bool(self.lent_last))

    def in_state(self, *, is_free: bool, now_ns: int) -> LoanBook:
        """Return the book after a published state of the microscope."""
        if is_free is (self.free_since_ns is not None):
            return self
        return replace(self, free_since_ns=now_ns if is_free else None)

    def answered(self, key: str, value: Parameter) -> LoanBook:
        """Return the book with the value that the microscope has answered."""
        loan = self.loans.get(key)
        return (
            self
            if loan is None
            else self._with(key, replace(loan, value=value, before=None, is_unsure=False, is_watched=True))
        )

    def gone(self, keys: Iterable[str]) -> LoanBook:
        left = {key: loan for key, loan in self.loans.items() if key not in set(keys)}
        return self if len(left) == len(self.loans) else replace(self, loans=left)

    def decided(self, parameters: Collection[str], kind: str) -> LoanBook:
        """Return the book after a setting outside of a measurement: it is the base."""
        return self.gone(key for key, loan in self.of_kind(kind) if loan.name in parameters) if self.loans else self

    def ended(self, keys: Iterable[str]) -> LoanBook:
        """Return the book with loans that are over."""
        changed = {key: replace(self.loans[key], is_over=True, why="") for key in keys if not self.loans[key].is_over}
        return replace(self, loans={**self.loans, **changed}) if changed else self

    def returned_by(self, lender: str, parameters: Collection[str] = ()) -> LoanBook:
        """Return the book after a RETURN; what another component has lent since is not this lender's any more."""
        return self.ended(
            key
            for key, loan in self.loans.items()
            if loan.lender == lender and (not parameters or loan.name in parameters)
        )

    def refused(self, key: str, why: str) -> LoanBook:
        """Return the book after a loan could not be set, or, with the reason, set back."""
        loan = self.loans.get(key)
        if loan is None:
            return self
        return self._with(key, replace(loan, value=loan.before or loan.value, before=None, is_unsure=True, why=why))

    def unsure(self, *, is_watched: bool) -> LoanBook:
        """Return the book when others may have acted: each value is read before anything follows from it.

        Args:
            is_watched: whether a person has acted in AUTOMATED.
        """
        loans = {
            key: replace(loan, is_unsure=True, is_watched=loan.is_watched and is_watched)
            for key, loan in self.loans.items()
        }
        return self if loans == self.loans else replace(self, loans=loans)

    def unwatched(self, name: str) -> LoanBook:
        """Return the book when a value may have changed without a decision about it."""
        unwatched = {key: replace(loan, is_watched=False) for key, loan in self.loans.items() if loan.name == name}
        return replace(self, loans={**self.loans, **unwatched}) if unwatched else self

    def used(self, now_ns: int) -> LoanBook:
        """Return the book after a request for settings: the microscope is idle since then."""
        return self if self.free_since_ns is None else replace(self, free_since_ns=now_ns)

    def _with(self, key: str, loan: Loan) -> LoanBook:
        return replace(self, loans={**self.loans, key: loan})


def key_of(name: str, kind: str) -> str:
    """Return the key of a loan: each kind of curve has values of its own."""
    return f"{name} {kind}" if name in names.OF_CURVES and kind else name


def kind_of(name: str, kind: str) -> str:
    return kind if name in names.OF_CURVES else ""


def may_be_lent(found: Setting) -> bool:
    return found.parameter.name in names.MAY_BE_LENT if found.is_lent is None else found.is_lent


def equal(a: Parameter, b: Parameter, within: float = _ROUNDED) -> bool:
    """Return whether two values are equal within a part of them; one without a unit is in SI."""
    try:
        first, second = float(a.value or ""), float(b.value or "")
    except ValueError:
        return a.value == b.value
    if a.unit != b.unit:
        first, second = (float(in_si(x, one.unit)[0]) if one.unit else x for x, one in ((first, a), (second, b)))
    return abs(first - second) <= within * max(abs(first), abs(second))


def _matters(name: str, action: str) -> bool:
    # a curve's points change no scan, and the voltage of a pulse neither
    if name in names.OF_TREATMENTS:
        return action in names.TREATMENTS
    return name not in names.OF_CURVES or action == names.START_SPEC or name in _LOCK_IN
