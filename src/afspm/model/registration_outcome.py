"""The outcome of registering a scan with earlier scans, which determines its position on the sample."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import IntEnum


class RegistrationOutcome(IntEnum):
    """The way in which a scan's position was determined; numbers as on the wire."""

    REGISTERED = 1
    """Matched with an earlier scan, or the first scan of all."""
    COARSE = 2
    """The estimator failed, and a coarse estimate took its place."""
    REFUSED = 3
    """Matched none of the earlier scans of its place: the position is dead reckoning."""
    FAILED = 4
    """Not registered because of an error, a time limit or a missing channel: the position is dead reckoning."""
    NEW = 5
    """No earlier scan shows its part of the sample: the position is dead reckoning."""

    @classmethod
    def of(cls, number: int, *, matched: bool) -> RegistrationOutcome:
        """Return the outcome for a number on the wire; `matched` decides for peers without outcomes."""
        known = {one.value for one in cls}
        return cls(number) if number in known else cls.REGISTERED if matched else cls.REFUSED

    @classmethod
    def from_label(cls, label: str) -> RegistrationOutcome:
        """Return the outcome for a label in a table.

        Raises:
            ValueError: there is no such outcome.
        """
        for one in cls:
            if one.label == label:
                return one
        raise ValueError(f"no outcome {label!r}")

    @property
    def is_registered(self) -> bool:
        """Return whether the position was measured, and not by dead reckoning."""
        return self in (RegistrationOutcome.REGISTERED, RegistrationOutcome.COARSE)

    @property
    def label(self) -> str:
        """Return the name for tables and files, such as "refused"."""
        return self.name.lower()


_NOTES = {
    RegistrationOutcome.COARSE: "{} of them coarsely",
    RegistrationOutcome.FAILED: "{} failed",
    RegistrationOutcome.REFUSED: "{} not recognised",
    RegistrationOutcome.NEW: "{} of a new place",
}


def registration_summary(outcomes: Iterable[RegistrationOutcome]) -> str:
    """Return the counts as a text: "registered 5 of 12 scans, 6 failed, 1 not recognised"."""
    counts = Counter(outcomes)
    registered = sum(count for outcome, count in counts.items() if outcome.is_registered)
    notes = [note.format(counts[outcome]) for outcome, note in _NOTES.items() if counts[outcome]]
    total = counts.total()
    return ", ".join([f"registered {registered} of {total} scan{'' if total == 1 else 's'}", *notes])
