"""The progress of a commissioning: the next step, and the consequences of each outcome. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from afspm.testing.conformance import Check, CheckOutcome, CheckResult

_MISMATCH: Final = "mismatch"
"""The word for a failed step in reports and in the public matrix."""
_GOES_ON = (CheckOutcome.PASSED, CheckOutcome.SKIPPED, CheckOutcome.UNSUPPORTED)
"""The outcomes after which later steps are possible: a step that is unsupported or not shown blocks no other step."""


_WORSE = (
    CheckOutcome.UNSUPPORTED,
    CheckOutcome.SKIPPED,
    CheckOutcome.PASSED,
    CheckOutcome.BLOCKED,
    CheckOutcome.DECLINED,
    CheckOutcome.FAILED,
)


def outcome_word(outcome: CheckOutcome) -> str:
    """Return the name of an outcome in reports and in the public matrix."""
    return _MISMATCH if outcome is CheckOutcome.FAILED else outcome.value


def outcome_of(word: str) -> CheckOutcome:
    """Return the outcome for its name in a report.

    Raises:
        ValueError: an unknown name.
    """
    return CheckOutcome.FAILED if word == _MISMATCH else CheckOutcome(word)


@dataclass(frozen=True, kw_only=True)
class CommissioningStep(Check):
    """A step of the commissioning.

    Attributes:
        explained: shown to the person before the step.
        after: required earlier steps: each must have passed, been skipped, or be unsupported.
        moves: True if the step acts on the microscope, so that the person confirms the step first.
        needs_panel: True if the person acts at the panel or the cable; without a panel the step is skipped.
        about_tip: True if the person says where the tip is.
        for_claims: True if the step only settles claims of the driver; the person may leave all these steps out.
        about_lines: True if the step reads the lines of a running scan.
        contact: True if the tip is at the sample; the tip is withdrawn after the step.
        remembered: True if a resumed commissioning skips the passed step; steps about the tip are always repeated.
        operations: operations of the public matrix that the step tests.
    """

    explained: str
    after: tuple[str, ...] = ()
    moves: bool = True
    needs_panel: bool = False
    about_tip: bool = False
    for_claims: bool = False
    about_lines: bool = False
    contact: bool = False
    remembered: bool = True
    operations: tuple[str, ...] = ()


@dataclass
class CommissioningProgress:
    """The results so far, by the names of the steps."""

    steps: Sequence[CommissioningStep]
    results: dict[str, CheckResult] = field(default_factory=dict)

    @classmethod
    def resumed(cls, steps: Sequence[CommissioningStep], before: Mapping[str, CheckResult]) -> CommissioningProgress:
        """Create the progress with earlier passes of remembered steps; all other steps are repeated."""
        kept = {
            step.name: before[step.name]
            for step in steps
            if step.remembered and step.name in before and before[step.name].outcome is CheckOutcome.PASSED
        }
        return cls(steps, kept)

    def next(self) -> CommissioningStep | None:
        """Return the next step; record steps that have become impossible as blocked.

        A gate, which is not remembered, is skipped if no remaining step needs it.
        """
        for step in self.steps:
            if step.name in self.results or not self._is_wanted(step):
                continue
            missing = [name for name in self._before(step) if self._outcome(name) not in _GOES_ON]
            if not missing:
                return step
            self.results[step.name] = CheckResult(
                step.name, step.title, CheckOutcome.BLOCKED, f"first: {', '.join(missing)}"
            )
        return None

    @property
    def passed(self) -> bool:
        """True if there are results, and none is failed, blocked or declined."""
        found = [result.outcome for result in self.results.values()]
        return bool(found) and all(one in _GOES_ON for one in found)

    def not_done(self) -> list[str]:
        """Return which steps did not pass, and which ones they blocked, a line for each outcome."""
        found = {
            outcome: [step.name for step in self.steps if self._outcome(step.name) is outcome]
            for outcome in (CheckOutcome.FAILED, CheckOutcome.DECLINED, CheckOutcome.BLOCKED)
        }
        said = {
            CheckOutcome.FAILED: "failed",
            CheckOutcome.DECLINED: "declined",
            CheckOutcome.BLOCKED: "not tried, since they need those",
        }
        return [f"{said[outcome]}: {', '.join(steps)}" for outcome, steps in found.items() if steps]

    def operations(self) -> dict[str, str]:
        """Return the outcome of each operation of the matrix: the worst outcome of its steps.

        A pass outweighs skipped and unsupported steps.
        """
        found: dict[str, CheckOutcome] = {}
        for step in self.steps:
            outcome = self._outcome(step.name)
            for operation in step.operations if outcome else ():
                assert outcome is not None
                found[operation] = max(outcome, found.get(operation, outcome), key=_WORSE.index)
        return {operation: outcome_word(outcome) for operation, outcome in found.items()}

    def _is_wanted(self, step: CommissioningStep) -> bool:
        users = [other for other in self.steps if step.name in self._before(other)]
        gate = not step.remembered and not step.operations and bool(users)
        return not gate or any(user.name not in self.results for user in users)

    def _before(self, step: CommissioningStep) -> list[str]:
        # all ancestors: a gate is asked again after a resume
        known = {one.name: one for one in self.steps}
        found = dict.fromkeys(step.after)
        for name in step.after:
            found |= dict.fromkeys(self._before(known[name]))
        return [one.name for one in self.steps if one.name in found]

    def _outcome(self, name: str) -> CheckOutcome | None:
        result = self.results.get(name)
        return None if result is None else result.outcome
