"""The progress of a commissioning: which step is next, and what follows from the outcome of each. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from afspm.testing.commissioning.guide import Guide


class StepOutcome(Enum):
    """The outcome of a step."""

    PASSED = "passed"
    MISMATCH = "mismatch"
    SKIPPED = "skipped"
    UNSUPPORTED = "not supported"
    DECLINED = "declined"
    BLOCKED = "blocked"


_GOES_ON = (StepOutcome.PASSED, StepOutcome.SKIPPED, StepOutcome.UNSUPPORTED)
"""What is not supported, or not shown at the panel, keeps nothing else from being tried."""


_WORSE = (
    StepOutcome.UNSUPPORTED,
    StepOutcome.SKIPPED,
    StepOutcome.PASSED,
    StepOutcome.BLOCKED,
    StepOutcome.DECLINED,
    StepOutcome.MISMATCH,
)


@dataclass(frozen=True)
class CommissioningStep:
    """One step.

    Attributes:
        explained: what is done, and what the person is asked; shown before anything is done.
        remedy: what to do if it does not pass.
        after: the steps that come first: none of them may have found a mismatch, or have been declined.
        moves: it acts on the microscope, which the person has confirmed before.
        needs_panel: the person has to do something at the panel; skipped where there is none.
        contact: the tip is at the sample: it is withdrawn when the step is over.
        remembered: a resumed commissioning need not do it again; what concerns the tip is asked each time.
        operations: of the public matrix, that it tries.
        needs: actions and parameters without which there is nothing to try.
    """

    name: str
    title: str
    explained: str
    remedy: str
    do: Callable[[Guide], str]
    after: tuple[str, ...] = ()
    moves: bool = True
    needs_panel: bool = False
    contact: bool = False
    remembered: bool = True
    operations: tuple[str, ...] = ()
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class StepResult:
    """The outcome of a step, in a line for people."""

    outcome: StepOutcome
    line: str = ""


@dataclass
class CommissioningProgress:
    """The results so far, by the names of the steps."""

    steps: Sequence[CommissioningStep]
    results: dict[str, StepResult] = field(default_factory=dict)

    @classmethod
    def resumed(cls, steps: Sequence[CommissioningStep], before: Mapping[str, StepResult]) -> CommissioningProgress:
        """Keep what has passed before and can be remembered; the rest is done again."""
        kept = {
            step.name: before[step.name]
            for step in steps
            if step.remembered and step.name in before and before[step.name].outcome is StepOutcome.PASSED
        }
        return cls(steps, kept)

    def next(self) -> CommissioningStep | None:
        """Return the next step; those that can't be done any more are noted as blocked.

        A gate, which is not remembered, is passed over if nothing that needs it is left to do.
        """
        for step in self.steps:
            if step.name in self.results or not self._is_wanted(step):
                continue
            missing = [name for name in self._before(step) if self._outcome(name) not in _GOES_ON]
            if not missing:
                return step
            self.results[step.name] = StepResult(StepOutcome.BLOCKED, f"first: {', '.join(missing)}")
        return None

    @property
    def passed(self) -> bool:
        """True if nothing was found to be wrong, and nothing was left out that could be done."""
        found = [result.outcome for result in self.results.values()]
        return bool(found) and all(one in _GOES_ON for one in found)

    def operations(self) -> dict[str, str]:
        """Return the outcome of each operation of the matrix: the worst of the steps that tried it."""
        found: dict[str, StepOutcome] = {}
        for step in self.steps:
            outcome = self._outcome(step.name)
            for operation in step.operations if outcome else ():
                assert outcome is not None
                found[operation] = max(outcome, found.get(operation, outcome), key=_WORSE.index)
        return {operation: outcome.value for operation, outcome in found.items()}

    def _is_wanted(self, step: CommissioningStep) -> bool:
        users = [other for other in self.steps if step.name in self._before(other)]
        gate = not step.remembered and not step.operations and bool(users)
        return not gate or any(user.name not in self.results for user in users)

    def _before(self, step: CommissioningStep) -> list[str]:
        """Return all steps that come before a step, also those before these: a gate is asked again when resumed."""
        known = {one.name: one for one in self.steps}
        found = dict.fromkeys(step.after)
        for name in step.after:
            found |= dict.fromkeys(self._before(known[name]))
        return [one.name for one in self.steps if one.name in found]

    def _outcome(self, name: str) -> StepOutcome | None:
        result = self.results.get(name)
        return None if result is None else result.outcome
