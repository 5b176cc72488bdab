"""The flagged problems, each with what a person is to do about it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from afspm.model import Problem
from afspm.record.overview import Overview

_ADVICE = {
    Problem.TIP_SHAPE_CHANGED: "No component repairs the tip. Take over, condition or change the tip, then clear it.",
    Problem.DEVICE_MALFUNCTION: "Check microscope, controller and log. Clear it when the tip is safe.",
    Problem.FEEDBACK_NON_OPTIMAL: "Take over, adjust setpoint and gains until trace and retrace agree, then clear it.",
    Problem.THERMAL_DRIFT: "Take over, find the place again or wait until the drift is slower, then clear it.",
}
_OTHER = "Solve it, then clear it: until then, the components that measure wait."


@dataclass(frozen=True)
class Flag:
    """A flagged problem: its number and name, its flagger and when, and what is to be done."""

    number: int
    name: str
    by: str = ""
    since_ns: int | None = None
    advice: str = ""


def flags(overview: Overview) -> Iterator[Flag]:
    """Yield the problems that are flagged now."""
    control = overview.control
    for number in control.problems if control else ():
        now = overview.problem_timelines[number].now if number in overview.problem_timelines else None
        advice = advice_for(number, control.holder if control else None)
        yield Flag(number, overview.problems.name(number), now.by if now else "", now.start_ns if now else None, advice)


def advice_for(problem: int, holder: str | None) -> str:
    """Return what a person is to do about a flagged problem.

    Args:
        holder: the component in control; while problems are flagged, only one that solves one of them gets control.
    """
    if holder:
        return f"{holder} is in control to solve it: wait, or take over."
    return _ADVICE.get(Problem(problem), _OTHER) if problem in Problem._value2member_map_ else _OTHER
