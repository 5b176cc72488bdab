"""Counts how many scans were registered, altogether and lately."""

from __future__ import annotations

from collections import Counter, deque

from afspm.model import RegistrationOutcome, registration_summary
from afspm.plain_data import Plain

LATELY = 10
"""The number of scans by which the share of unregistered ones is judged."""


class RegistrationTally:
    """Counts the outcomes of registration. Scans of a new place are not among those by which the share is judged."""

    def __init__(self) -> None:
        self._counts: Counter[RegistrationOutcome] = Counter()
        self._lately: deque[bool] = deque(maxlen=LATELY)

    def add(self, outcome: RegistrationOutcome) -> None:
        """Count a scan."""
        self._counts[outcome] += 1
        if outcome is not RegistrationOutcome.NEW:
            self._lately.append(outcome.is_registered)

    @property
    def scans(self) -> int:
        """The number of scans so far."""
        return self._counts.total()

    def summary(self) -> str:
        """Return the counts for people."""
        return registration_summary(self._counts.elements())

    def exceeds(self, most_unregistered: float) -> bool:
        """Return whether more of the last scans were not registered than this share of `LATELY`."""
        return self._lately.count(False) > most_unregistered * LATELY

    def judge_anew(self) -> None:
        """Leave the scans so far out of the share: it was acted upon."""
        self._lately.clear()

    def to_dict(self) -> Plain:
        """Return it as plain JSON."""
        return {"counts": {str(int(one)): n for one, n in self._counts.items()}, "lately": list(self._lately)}

    def restore(self, plain: Plain) -> None:
        """Take up what `to_dict` gave."""
        self._counts = Counter({RegistrationOutcome(int(one)): int(n) for one, n in plain["counts"].items()})
        self._lately = deque(map(bool, plain["lately"]), LATELY)
