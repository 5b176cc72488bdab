"""What people are told of a change of control."""

from __future__ import annotations

from afspm.logic.arbitration import Ask, Control, Event, Row, Rules


def is_routine(before: Control, after: Control, ask: Ask, holder_told: str | None) -> bool:
    """Whether a change needs no telling: control is given back, or taken once more by who was told to have it last."""
    if (after.problems, after.mode, after.ended) != (before.problems, before.mode, before.ended) or after.problems:
        return False
    return ask.event is Event.RELEASE_CONTROL if after.holder is None else after.holder == holder_told


def said(before: Control, after: Control, ask: Ask, row: Row, rules: Rules) -> str:
    """A change of control in words, for the log."""
    parts = []
    if after.holder != before.holder and after.holder is not None:
        parts.append(f"{after.holder} is in control")
        if after.solving:
            parts.append(f"to solve {rules.problems.name(after.solving)}")
    for number in sorted(after.problems.keys() ^ before.problems.keys()):
        done = "flagged" if number in after.problems else "cleared"
        parts.append(f"{rules.problems.name(number)} is {done} by {ask.who};")
    if after.mode is not before.mode:
        parts.append(f"the mode is {after.mode.name} by {ask.who};")
    if after.ended and not before.ended:
        parts.append(f"the experiment is ended by {ask.who};")
    if before.holder is not None and after.holder is None and row.cause is not None:
        parts.append(f"{before.holder} is no longer in control: {row.cause.value}")
    return " ".join(parts).rstrip(";") or f"{ask.who} {ask.event.value}"
