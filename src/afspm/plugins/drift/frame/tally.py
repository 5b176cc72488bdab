"""Counts of registered scans, in total and among the latest scans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from afspm.basics import replace
from afspm.model import RegistrationOutcome, registration_summary

LATELY = 10
"""Number of latest scans that count in the share of unregistered scans."""


@dataclass(frozen=True)
class RegistrationTally:
    """Counts of registration outcomes. Scans of a new place do not count in the share of unregistered scans."""

    counts: Mapping[RegistrationOutcome, int] = field(default_factory=dict)
    lately: tuple[bool, ...] = ()

    def add(self, outcome: RegistrationOutcome) -> RegistrationTally:
        lately = self.lately
        if outcome is not RegistrationOutcome.NEW:
            lately = (*lately, outcome.is_registered)[-LATELY:]
        return RegistrationTally({**self.counts, outcome: self.counts.get(outcome, 0) + 1}, lately)

    @property
    def scans(self) -> int:
        return sum(self.counts.values())

    def summary(self) -> str:
        return registration_summary(outcome for outcome, count in self.counts.items() for _ in range(count))

    def exceeds(self, most_unregistered: float) -> bool:
        """Return whether the share of unregistered scans among the last `LATELY` exceeds a limit.

        The share refers to `LATELY` scans even if fewer have been counted.
        """
        return self.lately.count(False) > most_unregistered * LATELY

    def share_restarted(self) -> RegistrationTally:
        """Return the tally with an empty share of unregistered scans, when a search for the sample begins."""
        return replace(self, lately=())
