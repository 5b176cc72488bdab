"""Problems by name: the problems on the wire, and further problems of an experiment file."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping
from enum import IntEnum

from afspm.basics.errors import InvalidValue

HIGHEST_PROBLEM = 255  # one byte on the wire
STOPPED_BY_AGENT = "stopped-by-agent"
"""The problem flagged by an agent's tool `stop`. Every experiment with an agent has it, by default as number 255."""
QUIET_HOURS = "quiet-hours"
"""The problem that a `QuietHours` flags for its pause. Every experiment with one has it, by default as number 254."""
CONDITIONS = "conditions"
"""The name under which the scheduler flags the problem of a condition, and clears it."""
STOPPER = " stop"
"""Suffix of the name under which an agent stops, over a second connection: the first may wait for the microscope."""


class Problem(IntEnum):
    """Problems of every experiment; experiment files add more, with higher numbers."""

    NONE = 0
    TIP_SHAPE_CHANGED = 1
    DEVICE_MALFUNCTION = 2
    FEEDBACK_NON_OPTIMAL = 3
    THERMAL_DRIFT = 4


class ProblemNames(Mapping[str, int]):
    """The problems of an experiment: name -> number, and back.

    Args:
        named: names and numbers (5 to 255) of the problems in the experiment file.

    Raises:
        InvalidValue: a number or name is taken or out of range.
    """

    def __init__(self, named: Mapping[str, int] | None = None) -> None:
        self._numbers = {_plain(p.name): int(p) for p in Problem if p is not Problem.NONE}
        for name, number in (named or {}).items():
            if _plain(name) in self._numbers:
                raise InvalidValue(f"the problem {name!r} exists already", where="[problems]")
            if not len(Problem) <= number <= HIGHEST_PROBLEM or number in self._numbers.values():
                raise InvalidValue(
                    f"the problem {name!r} can't have the number {number}",
                    where="[problems]",
                    hint=f"choose a free one from {len(Problem)} to {HIGHEST_PROBLEM}",
                )
            self._numbers[_plain(name)] = number
        self._names = {number: name for name, number in self._numbers.items()}

    def __repr__(self) -> str:
        return f"ProblemNames({self._numbers})"

    def number(self, problem: str | int) -> int:
        """Return the number of a problem given by number or by name ("tip-shape-changed", "EP_TIP_SHAPE_CHANGED").

        Raises:
            InvalidValue: there is no such problem.
        """
        if isinstance(problem, str):
            number = self._numbers.get(_plain(problem))
            if number is None:
                close = difflib.get_close_matches(_plain(problem), self._numbers, 1)
                raise InvalidValue(
                    f"there is no problem {problem!r}",
                    hint=f"did you mean {close[0]!r}?" if close else f"known: {', '.join(self._numbers)}",
                )
            return number
        if int(problem) not in self._names:
            raise InvalidValue(f"there is no problem with the number {int(problem)}", hint="name it under [problems]")
        return int(problem)

    def name(self, number: int) -> str:
        """Return the name of a problem; "problem 7" for a number without a name."""
        return self._names.get(number, f"problem {number}")

    def __getitem__(self, name: str) -> int:
        return self._numbers[_plain(name)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)


def _plain(name: str) -> str:
    # "EP_TIP_SHAPE_CHANGED" and "Tip shape changed" become "tip-shape-changed"
    return name.strip().lower().replace("_", "-").replace(" ", "-").removeprefix("ep-")
