"""The flagged problems, each with advice for a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from afspm.model import STOPPED_BY_AGENT, ControlMode, ControlState, Problem
from afspm.night import ROUTINE, Overview

_ADVICE = {
    Problem.TIP_SHAPE_CHANGED: "condition or change the tip, then clear the problem.",
    Problem.DEVICE_MALFUNCTION: "check microscope, controller and log; clear the problem when the tip is safe.",
    Problem.FEEDBACK_NON_OPTIMAL: "adjust setpoint and gains until trace and retrace agree, then clear the problem.",
    Problem.THERMAL_DRIFT: "find the place again, or wait until the drift is slower, then clear the problem.",
}
_OTHER = "solve the problem, then clear it."


@dataclass(frozen=True)
class Flag:
    """A flagged problem: its number and name, the component that flagged it, the time, and advice."""

    number: int
    name: str
    by: str = ""
    since_ns: int | None = None
    advice: str = ""


def flags(overview: Overview) -> Iterator[Flag]:
    """Yield the problems that are flagged now."""
    control = overview.control
    for number in control.problems if control else ():
        now = overview.timelines.problems[number].now if number in overview.timelines.problems else None
        name, by, since_ns = overview.problems.name(number), now.by if now else "", now.start_ns if now else None
        advice = f"{ROUTINE}." if overview.is_routine(now) else advice_for(number, control, name) if control else ""
        yield Flag(number, name, by, since_ns, advice)


def advice_for(problem: int, control: ControlState, name: str = "") -> str:
    """Return the advice for a person about a flagged problem."""
    if control.holder:  # while problems are flagged, only a component that solves a problem gets control
        return f"{control.holder} is in control to solve it: wait, or take over."
    if name == STOPPED_BY_AGENT:
        return "An agent has stopped the experiment: look at the microscope, then clear the problem."
    known = _ADVICE.get(Problem(problem), _OTHER) if problem in Problem._value2member_map_ else _OTHER
    if control.mode is ControlMode.MANUAL:
        return known[0].upper() + known[1:]
    return f"No component works on it. Take over, {known}"
