"""The state diagram of control, computed from the arbitration table, so that both always agree."""

from __future__ import annotations

from types import MappingProxyType

from afspm.model import ControlMode
from afspm.scheduler.control.arbitration import ArbitrationEvent, ArbitrationState, ControlInput, Rules, apply, row_for

_MODES = (ControlMode.AUTOMATED, ControlMode.MANUAL)


def kind(control: ArbitrationState) -> str:
    """Return the node of the diagram for a state."""
    if control.ended:
        return "ended"
    if control.mode is ControlMode.MANUAL:
        return "manual"
    if control.problems:
        return "solver in control" if control.holder else "flagged, no component in control"
    return "in control" if control.holder else "free"


def edges() -> list[tuple[str, str, str]]:
    """Return all (from, label, to) between different nodes, in the order of the table."""
    found: dict[tuple[str, str, str], None] = {}
    for event in ArbitrationEvent:
        for control in _states():
            for who in ("a", "b"):
                for number in (0, 1, 2):
                    ask = ControlInput(event, who, number)
                    after = apply(row_for(control, ask, Rules()), control, ask)
                    if kind(after) != kind(control):
                        found[kind(control), _label(ask, control, after), kind(after)] = None
    return list(found)


def mermaid() -> str:
    """Return the diagram as text for mermaid, as the documentation shows it."""
    names = {"free": "Free", "in control": "Held", "flagged, no component in control": "Flagged"}
    names |= {"solver in control": "Solving", "manual": "Manual", "ended": "Ended"}
    lines = ["stateDiagram-v2", "    [*] --> Free"]
    lines += [f'    state "{text}" as {name}' for text, name in names.items()]
    merged: dict[tuple[str, str], list[str]] = {}
    for before, label, after in edges():
        if after != "ended":
            merged.setdefault((before, after), []).append(label)
    lines += [f"    {names[a]} --> {names[b]}: {' / '.join(labels)}" for (a, b), labels in merged.items()]
    lines += [f"    {name} --> Ended: {ArbitrationEvent.END.value}" for name in names.values() if name != "Ended"]
    return "\n".join([*lines, "    Ended --> [*]"]) + "\n"


def _label(ask: ControlInput, before: ArbitrationState, after: ArbitrationState) -> str:
    if ask.event is ArbitrationEvent.SET_MODE:
        return f"sets the mode {after.mode.name.lower()}"
    if ask.event in (ArbitrationEvent.DEAD, ArbitrationEvent.IDLE, ArbitrationEvent.RELEASE_CONTROL):
        return f"the holder {ask.event.value}"
    if ask.event is ArbitrationEvent.CLEAR and after.problems:
        return "the solver's flag is removed, others are left"
    if ask.event is ArbitrationEvent.CLEAR:
        return "the last flag is removed"
    return str(ask.event.value)


def _states() -> list[ArbitrationState]:
    # two problems and two components suffice to reach each kind of state
    states = []
    for mode in _MODES:
        for flagged in ({}, {1: "b"}, {1: "b", 2: "b"}):
            problems = MappingProxyType(flagged)
            states.append(ArbitrationState(mode, None, 0, problems))
            if mode is ControlMode.AUTOMATED:
                states += [ArbitrationState(mode, "a", solving, problems) for solving in (flagged or {0: ""})]
    return states
