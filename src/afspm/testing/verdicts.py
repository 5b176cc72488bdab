"""The verdicts of a check, of translators as of clients: what was expected and what came, as a line of a table."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from rich.console import Console
from rich.text import Text

NAME_WIDTH = 29


class Failed(AssertionError):
    """The program under test does not do what the wire format says.

    Args:
        expected, came: in words of a physicist, without a full stop.
    """

    def __init__(self, expected: str, came: str) -> None:
        super().__init__(f"expected {expected}; came {came}")


class Skipped(Exception):
    """It can't be checked here; the text says why."""


class Lost(Exception):
    """Nothing more can be checked: a process has ended, or control was taken away."""


def expect(holds: object, expected: str, came: str) -> None:
    """Raises Failed unless it holds."""
    if not holds:
        raise Failed(expected, came)


def near(a: float, b: float, relative: float = 1e-3, absolute: float = 0.0) -> bool:
    """True if two numbers are the same to a controller's precision."""
    return math.isclose(a, b, rel_tol=relative, abs_tol=absolute)


class CheckOutcome(Enum):
    """The outcome of one check."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class CheckResult:
    """One check.

    Attributes:
        line: what was expected and what came, or why it was skipped.
        complaints: of a check that failed, what is to be known besides: warnings and errors that were logged meanwhile.
        real_s: how long it took.
    """

    name: str
    title: str
    outcome: CheckOutcome
    line: str = ""
    real_s: float = 0.0
    complaints: tuple[str, ...] = ()


MARKS = {
    CheckOutcome.PASSED: ("✓", "green"),
    CheckOutcome.FAILED: ("✗", "bold red"),
    CheckOutcome.SKIPPED: ("–", "yellow"),
}


def show_result(result: CheckResult, console: Console) -> None:
    """Print one check; what was expected and what came below it."""
    mark, style = MARKS[result.outcome]
    line = Text.assemble((mark, style), f" {result.name:{NAME_WIDTH}} ", (result.title, "dim"))
    for told in filter(None, (result.line, *result.complaints)):
        line.append(f"\n    {told}", style)
    console.print(line, soft_wrap=True)
