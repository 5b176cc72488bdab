"""Repairs that learn: counts of outcomes, and the choice of the next treatment.

**Theory of operation.** For each flaw and treatment, `TipExperience` counts how often the treatment cured the tip,
worsened it, or did nothing. The next treatment is chosen by Thompson sampling: a probability of each outcome is drawn
from the counts, and the treatment with the shortest expected repair under this draw is taken. So a treatment is tried
the more often the more likely it is the best, and a new treatment is tried now and then.

The counts of a night, weakened, become the prior of the next night, since the tip may then answer otherwise. Within a
night the weight of old outcomes falls with each new one, and a run of failures that the counts call improbable weakens
the counts of its flaw at once: the tip may have begun to answer otherwise.

This module uses no clock, no files and no messages. Each draw follows from the number of the night and of its outcomes,
so a restarted process, or a replay, chooses the same treatment.

A table of counts can be read and corrected by a person; a model of thresholds and depths needs fewer outcomes, but has
to be right. Its price: treatments of similar size learn nothing from each other. The flaw comes from a judge of the
corrector's own, since the message of a classifier has only a score, and may come from any classifier.

The constants were chosen among some twenty sets, on nights with the public half of the simulated answers and with one
sealed key (`benchmarks/tip_learning.py` judges other nights).
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from afspm.components.tip_treatments import Treatment

CURED, WORSENED, UNCHANGED = "cured", "worsened", "unchanged"
OUTCOMES = (CURED, WORSENED, UNCHANGED)
UNKNOWN_FLAW = "unknown"

PRIOR = {CURED: 0.2, WORSENED: 0.1, UNCHANGED: 0.4}
"""Prior counts of an untried treatment: of little weight, and most for no effect."""
MOST_OF_PAST_NIGHTS = 2.0
"""Largest number of outcomes of a treatment that count from past nights."""
MOST_COUNTED = 12.0
"""Largest number of outcomes of a treatment that count altogether: older outcomes fade."""
IMPROBABLE = 0.02
"""Probability of a run of failures below which the counts of its flaw are weakened."""
LEFT_AFTER_SURPRISE = 1.0
"""Largest number of outcomes of a treatment that count after such a run."""
SHARPNESS = 5.0
"""Factor on all counts for a draw. Plain Thompson sampling (1) explores for longer than a night has repairs."""
_RAREST_CURE = 1e-3  # probability assumed at least, so that no expected repair is infinitely long


@dataclass(frozen=True)
class OutcomeCounts:
    """Outcome counts of one treatment for one flaw; an older outcome counts less than one."""

    cured: float = 0.0
    worsened: float = 0.0
    unchanged: float = 0.0

    @property
    def total(self) -> float:
        return self.cured + self.worsened + self.unchanged

    def of_at_most(self, most: float) -> OutcomeCounts:
        """Return the counts scaled down to a total of at most `most`."""
        share = min(1.0, most / self.total) if self.total else 1.0
        return OutcomeCounts(share * self.cured, share * self.worsened, share * self.unchanged)

    def with_outcome(self, outcome: str) -> OutcomeCounts:
        """Return the counts with one more outcome."""
        faded = self.of_at_most(MOST_COUNTED - 1.0)
        return replace(faded, **{outcome: getattr(faded, outcome) + 1.0})

    @property
    def cures(self) -> float:
        """The expected probability of a cure."""
        return (self.cured + PRIOR[CURED]) / (self.total + sum(PRIOR.values()))


Counts = dict[str, dict[str, OutcomeCounts]]
"""Outcome counts by flaw, then by treatment."""


@dataclass
class TipExperience:
    """Outcomes of treatments, by flaw, and the choice of the next treatment (see the module).

    Attributes:
        nights: number of nights before this one.
        outcomes: number of outcomes in this night.
        counts: counts of outcomes, by flaw, then by treatment.
        doubt: by flaw, the probability that the counts give to the present run of failures.
    """

    nights: int = 0
    outcomes: int = 0
    counts: Counts = field(default_factory=dict)
    doubt: dict[str, float] = field(default_factory=dict)

    def choose(self, flaw: str, allowed: Sequence[Treatment]) -> Treatment:
        """Return the allowed treatment with the shortest expected repair under a draw from the counts."""
        draw = random.Random(f"{self.nights} {self.outcomes}")
        drawn = {
            one: [self._drawn(one, treatment, draw) for treatment in allowed]
            for one in dict.fromkeys([flaw, *sorted(self.counts)])
        }
        # a worsened tip needs one more repair, of the mean length, beside the one that goes on
        alone = [min(1.0 / max(cures, _RAREST_CURE) for cures, _ in of_flaw) for of_flaw in drawn.values()]
        another = sum(alone) / len(alone)
        lengths = [(1.0 + worsens * another) / max(cures, _RAREST_CURE) for cures, worsens in drawn[flaw]]
        return allowed[lengths.index(min(lengths))]

    def _drawn(self, flaw: str, treatment: Treatment, draw: random.Random) -> tuple[float, float]:
        counts = self.of(flaw, treatment)
        cured, worsened, unchanged = (
            draw.gammavariate(SHARPNESS * (getattr(counts, outcome) + PRIOR[outcome]), 1.0) for outcome in OUTCOMES
        )
        total = cured + worsened + unchanged
        return cured / total, worsened / total

    def of(self, flaw: str, treatment: Treatment) -> OutcomeCounts:
        return self.counts.get(flaw, {}).get(str(treatment), OutcomeCounts())

    def learn(self, flaw: str, treatment: Treatment, outcome: str) -> bool:
        """Count an outcome. Return whether an improbable run of failures has weakened the counts of the flaw."""
        run = 1.0 if outcome == CURED else self.doubt.get(flaw, 1.0) * (1.0 - self.of(flaw, treatment).cures)
        surprised = run < IMPROBABLE
        if surprised:
            self.counts[flaw] = _weakened(self.counts.get(flaw, {}), LEFT_AFTER_SURPRISE)
        self.doubt[flaw] = 1.0 if surprised else run
        self.outcomes += 1
        self.counts.setdefault(flaw, {})[str(treatment)] = self.of(flaw, treatment).with_outcome(outcome)
        return surprised

    def for_next_night(self) -> TipExperience:
        """Return the experience as the prior of the next night."""
        counts = {flaw: _weakened(treatments, MOST_OF_PAST_NIGHTS) for flaw, treatments in self.counts.items()}
        return TipExperience(self.nights + 1, counts=counts)


def _weakened(treatments: Mapping[str, OutcomeCounts], most: float) -> dict[str, OutcomeCounts]:
    return {name: counts.of_at_most(most) for name, counts in treatments.items()}
