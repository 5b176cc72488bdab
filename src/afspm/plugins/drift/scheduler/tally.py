"""Counts how many scans were registered, altogether and lately."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics.frozen import replace
from afspm.model import RegistrationOutcome, registration_summary

LATELY = 10
"""The number of scans by which the share of unregistered ones is judged."""


@dataclass(frozen=True)
class RegistrationTally:
    """Counts the outcomes of registration. Scans of a new place are not among those by which the share is judged."""

    counts: Mapping[RegistrationOutcome, int] = field(default_factory=dict)
    lately: tuple[bool, ...] = ()

    def add(self, outcome: RegistrationOutcome) -> RegistrationTally:
        """Count a scan."""
        lately = self.lately
        if outcome is not RegistrationOutcome.NEW:
            lately = (*lately, outcome.is_registered)[-LATELY:]
        return RegistrationTally({**self.counts, outcome: self.counts.get(outcome, 0) + 1}, lately)

    @property
    def scans(self) -> int:
        """The number of scans so far."""
        return sum(self.counts.values())

    def summary(self) -> str:
        """Return the counts for people."""
        return registration_summary(outcome for outcome, count in self.counts.items() for _ in range(count))

    def exceeds(self, most_unregistered: float) -> bool:
        """Return whether more of the last scans were not registered than this share of `LATELY`."""
        return self.lately.count(False) > most_unregistered * LATELY

    def share_restarted(self) -> RegistrationTally:
        """Leave the scans so far out of the share: it was acted upon."""
        return replace(self, lately=())
