"""The language of forbidden states: comparisons of quantities, joined by `and`, `or` and `not`.

    abs(tip-bias-voltage) > 1 V and zctrl-setpoint > 100 pA

| part | form |
| --- | --- |
| comparison | two terms with `<`, `<=`, `>` or `>=`; at least one is a quantity |
| term | a name, `abs(name)`, `abs(name - name)`, or a number with its unit |
| switch | a name alone: a switch of the microscope (`x-feedback-on`), or its state (`SCANNING`) |
| act | `changes(name)`: true while a request is judged that sets this parameter or begins this action |

There is no equality: controllers round. `parse` moves every `not` into the comparisons, so that a tree has only `and`
and `or`. Then a state in which no comparison is truer is not worse, which `ForbiddenState` relies on.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final

from afspm.basics.errors import AfspmError
from afspm.basics.formatting import quantity
from afspm.basics.units import convert, si_unit

Value = float | bool
Known = Mapping[str, Value | None]
"""Values by name, numbers in SI; None or a missing name: unknown."""

BORDER: Final = 1e-6
"""Relative distance within which a value lies on its bound: controllers round, some to single precision."""
_LONGEST, _DEEPEST = 1000, 20  # characters, and nested brackets: the parser calls itself for each
_OPPOSITE: Final = {"<": ">=", "<=": ">", ">": "<=", ">=": "<"}
_WORDS = frozenset({"and", "or", "not", "abs", "changes"})
_TOKEN = re.compile(
    r"(?P<space>\s+)|(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<sign><=|>=|[<>])|(?P<bracket>[()])"
    r"|(?P<word>[^\s()<>=!&|\d,;\"'][^\s()<>=!&|,;\"']*)"
)
_HABITS = {"=": "there is no equality, since controllers round: compare with < or >", "!": "write `not`"} | {
    "&": "write `and`", "|": "write `or`", ",": "numbers have a decimal point, not a comma",
}  # fmt: skip


class RuleError(AfspmError):
    """The error that a rule can't be read; `at` is the place in its text, counted from 0."""

    def __init__(self, what: str, at: int, hint: str = "") -> None:
        super().__init__(what, hint=hint)
        self.at = at


@dataclass(frozen=True)
class RuleTerm:
    """A side of a comparison: a quantity, or a number.

    Attributes:
        name: the name of the quantity; empty for a number.
        number: the number in `unit`, which is an SI unit; "" without a unit, also for a quantity.
        absolute: whether the amount of the quantity counts.
        minus: the name of a quantity that is subtracted before; empty without one.
        at: the place in the rule.
        name_sign, minus_sign: factors of both quantities: -1 for an alias that counts the other way.
    """

    name: str = ""
    number: float = 0.0
    unit: str = ""
    absolute: bool = False
    minus: str = ""
    at: int = 0
    name_sign: float = 1.0
    minus_sign: float = 1.0

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(filter(None, (self.name, self.minus)))

    def value(self, known: Known) -> float | None:
        if not self.name:
            return self.number
        value, less = known.get(self.name), known.get(self.minus) if self.minus else 0.0
        if value is None or less is None:
            return None
        if self.absolute:
            return abs(self.name_sign * value - self.minus_sign * less)
        return self.name_sign * float(value)

    def renamed(self, old: str, new: str, sign: float) -> RuleTerm:
        """Return the term with `sign` times the quantity `new` in place of the quantity `old`."""
        term = replace(self, name=new, name_sign=sign) if self.name == old else self
        return replace(term, minus=new, minus_sign=sign) if term.minus == old else term

    def __str__(self) -> str:
        if not self.name:
            return quantity(self.number, self.unit, 6)
        signs = (self.name_sign, self.minus_sign)
        shown = [f"{'-' if sign < 0 else ''}{name}" for name, sign in zip(self.names, signs, strict=False)]
        return f"abs({' - '.join(shown)})" if self.absolute else shown[0]


@dataclass(frozen=True)
class RuleComparison:
    """A comparison of two terms."""

    left: RuleTerm
    sign: str
    right: RuleTerm

    @property
    def names(self) -> frozenset[str]:
        return frozenset((*self.left.names, *self.right.names))

    def excess(self, known: Known) -> float | None:
        """Return how far the comparison is from its border, above zero where it is true; None if unknown."""
        left, right = self.left.value(known), self.right.value(known)
        if left is None or right is None:
            return None
        return left - right if self.sign[0] == ">" else right - left

    def holds(self, known: Known) -> bool | None:
        excess, left, right = self.excess(known), self.left.value(known), self.right.value(known)
        if excess is None or left is None or right is None:
            return None
        border = BORDER * max(abs(left), abs(right))
        return excess >= -border if self.sign[1:] else excess > border

    def opposite(self) -> RuleComparison:
        return RuleComparison(self.left, _OPPOSITE[self.sign], self.right)


@dataclass(frozen=True)
class RuleSwitch:
    """A switch or state of the microscope that has to be on, or off."""

    name: str
    on: bool = True
    at: int = 0

    @property
    def names(self) -> frozenset[str]:
        return frozenset({self.name})

    def excess(self, known: Known) -> float | None:
        holds = self.holds(known)
        return None if holds is None else 1.0 if holds else -1.0

    def holds(self, known: Known) -> bool | None:
        value = known.get(self.name)
        return None if value is None else bool(value) is self.on

    def opposite(self) -> RuleSwitch:
        return RuleSwitch(self.name, not self.on, self.at)


RuleAtom = RuleComparison | RuleSwitch


@dataclass(frozen=True)
class RuleJunction:
    """Parts joined by `or` (`is_any`) or by `and`."""

    parts: tuple[RuleTree, ...]
    is_any: bool

    def opposite(self) -> RuleJunction:
        return RuleJunction(tuple(part.opposite() for part in self.parts), not self.is_any)


RuleTree = RuleAtom | RuleJunction


def change_of(name: str) -> str:
    """Return the switch of a rule that is on while a request changes a parameter, or begins an action."""
    return f"changes({name})"


def changed_name(switch: str) -> str:
    """Return the parameter or action of a `change_of`; empty for another switch."""
    return switch.removeprefix("changes(")[:-1] if switch.startswith("changes(") else ""


def atoms(tree: RuleTree) -> Iterator[RuleAtom]:
    """Yield the comparisons and switches of a rule, from left to right."""
    if isinstance(tree, RuleJunction):
        for part in tree.parts:
            yield from atoms(part)
    else:
        yield tree


def renamed(tree: RuleTree, old: str, new: str, sign: float) -> RuleTree:
    """Return a rule with `sign` times the quantity `new` in place of the quantity `old`."""
    match tree:
        case RuleJunction():
            return replace(tree, parts=tuple(renamed(part, old, new, sign) for part in tree.parts))
        case RuleSwitch():
            found = {old: new, change_of(old): change_of(new)}
            return replace(tree, name=found.get(tree.name, tree.name))
    return replace(tree, left=tree.left.renamed(old, new, sign), right=tree.right.renamed(old, new, sign))


def holds(tree: RuleTree, known: Known, false: Collection[RuleAtom] = ()) -> bool | None:
    """Return whether a rule holds; None if that depends on a value that is unknown.

    Args:
        false: atoms taken as false.
    """
    if not isinstance(tree, RuleJunction):
        return False if tree in false else tree.holds(known)
    found = [holds(part, known, false) for part in tree.parts]
    if tree.is_any in found:
        return tree.is_any
    return None if None in found else not tree.is_any


# --- the parser -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    at: int


def parse(text: str) -> RuleTree:
    """Return the tree of a rule.

    Raises:
        RuleError: the text is not a rule, or a unit is unknown.
    """
    if len(text) > _LONGEST:
        raise RuleError(f"a rule has at most {_LONGEST} characters, not {len(text)}", 0, "write it as several rules")
    return _Parser(text).rule()


def _tokens(text: str) -> Iterator[_Token]:
    at = 0
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise RuleError(f"{text[at]!r} is not expected here", at, _HABITS.get(text[at], ""))
        if match.lastgroup != "space":
            yield _Token(match.lastgroup or "", match[0], at)
        at = match.end()
    yield _Token("end", "", at)


class _Parser:
    def __init__(self, text: str) -> None:
        self._tokens = list(_tokens(text))
        self._next, self._depth = 0, 0

    def rule(self) -> RuleTree:
        tree = self._joined("or", lambda: self._joined("and", self._denied))
        if self._depth == 0 and self._here.kind != "end":
            raise self._unexpected("`and`, `or` or the end")
        return tree

    def _joined(self, word: str, part: Callable[[], RuleTree]) -> RuleTree:
        parts = [part()]
        while self._here.text == word:
            self._take()
            parts.append(part())
        return parts[0] if len(parts) == 1 else RuleJunction(tuple(parts), word == "or")

    def _denied(self) -> RuleTree:
        is_denied = False
        while self._here.text == "not":
            self._take()
            is_denied = not is_denied
        tree = self._bracketed() if self._here.text == "(" else self._comparison()
        return tree.opposite() if is_denied else tree

    def _bracketed(self) -> RuleTree:
        bracket = self._take()
        self._depth += 1
        if self._depth > _DEEPEST:
            raise RuleError(f"brackets are nested more than {_DEEPEST} deep", bracket.at)
        tree = self.rule()
        self._depth -= 1
        self._require(")")
        return tree

    def _comparison(self) -> RuleTree:
        left = self._term()
        if self._here.kind != "sign":
            if left.name and not left.absolute:
                return RuleSwitch(left.name, at=left.at)
            raise self._unexpected("<, <=, > or >=")
        sign, right = self._take().text, self._term()
        if not (left.name or right.name):
            raise RuleError("it compares two numbers, and no quantity", left.at)
        if self._here.kind == "sign":
            raise RuleError("a comparison has two sides", self._here.at, "join two comparisons by `and`")
        return RuleComparison(left, sign, right)

    def _term(self) -> RuleTerm:
        token = self._take()
        if token.kind == "number":
            return self._number(token)
        if token.text == "abs":
            self._require("(")
            name, minus = self._quantity(), ""
            if self._here.text == "-":
                self._take()
                minus = self._quantity().text
            self._require(")")
            return RuleTerm(name.text, absolute=True, minus=minus, at=name.at)
        if token.text == "changes":
            self._require("(")
            name = self._quantity()
            self._require(")")
            return RuleTerm(change_of(name.text), at=name.at)
        if token.kind != "word" or token.text in _WORDS:
            raise self._unexpected("a name or a number", token)
        return RuleTerm(token.text, at=token.at)

    def _quantity(self) -> _Token:
        name = self._take()
        if name.kind != "word" or name.text in _WORDS or name.text == "-":
            raise self._unexpected("the name of a quantity", name)
        return name

    def _number(self, token: _Token) -> RuleTerm:
        unit = ""
        if self._here.kind == "word" and self._here.text not in _WORDS:
            unit = self._take().text
        try:
            si = si_unit(unit)
            number = float(convert(float(token.text), unit, si))
        except AfspmError as error:
            raise RuleError(error.what, token.at, error.hint) from error
        if not math.isfinite(number):
            raise RuleError(f"{token.text} is not a finite number", token.at)
        return RuleTerm(number=number, unit=si, at=token.at)

    @property
    def _here(self) -> _Token:
        return self._tokens[self._next]

    def _take(self) -> _Token:
        token = self._here
        self._next = min(self._next + 1, len(self._tokens) - 1)
        return token

    def _require(self, text: str) -> None:
        if self._here.text != text:
            raise self._unexpected(f"`{text}`")
        self._take()

    def _unexpected(self, wanted: str, token: _Token | None = None) -> RuleError:
        token = token or self._here
        found, word = repr(token.text) if token.text else "the rule ends", token.text.lower()
        hint = f"write `{word}`" if word in _WORDS and token.text != word else ""
        return RuleError(f"{found} where {wanted} is expected", token.at, hint)
