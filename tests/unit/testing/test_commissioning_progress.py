"""The order of a commissioning's steps: consequences of an outcome, resumed steps, and the matrix."""

from __future__ import annotations

import pytest

from afspm.testing.commissioning.progress import CommissioningProgress, CommissioningStep
from afspm.testing.commissioning.steps import OPERATIONS, all_steps
from afspm.testing.conformance import CheckOutcome, CheckResult


def step(name: str, *after: str, **facts: object) -> CommissioningStep:
    return CommissioningStep(name=name, title=name, do=lambda guide: "", explained="", after=after, **facts)  # type: ignore[arg-type]


STEPS = (
    step("read"),
    step("gate", "read", remembered=False),
    step("scan", "gate", operations=("scan",)),
    step("late", "scan", operations=("scan",)),
)


def walk(progress: CommissioningProgress, outcomes: dict[str, CheckOutcome]) -> list[str]:
    done = []
    while (now := progress.next()) is not None:
        done.append(now.name)
        progress.results[now.name] = CheckResult(now.name, now.title, outcomes.get(now.name, CheckOutcome.PASSED))
    return done


def test_steps_are_done_in_order() -> None:
    progress = CommissioningProgress(STEPS)
    assert walk(progress, {}) == ["read", "gate", "scan", "late"]
    assert progress.passed


@pytest.mark.parametrize("outcome", [CheckOutcome.FAILED, CheckOutcome.DECLINED])
def test_failed_or_declined_step_blocks_dependent_steps(outcome: CheckOutcome) -> None:
    progress = CommissioningProgress(STEPS)
    assert walk(progress, {"gate": outcome}) == ["read", "gate"]
    assert progress.results["late"].outcome is CheckOutcome.BLOCKED
    assert not progress.passed


def test_unsupported_step_blocks_nothing() -> None:
    progress = CommissioningProgress(STEPS)
    assert walk(progress, {"read": CheckOutcome.SKIPPED})[1:] == ["gate", "scan", "late"]
    assert progress.passed


def test_resumed_commissioning_repeats_steps_of_the_tip_and_skips_passed_ones() -> None:
    first = CommissioningProgress(STEPS)
    walk(first, {"late": CheckOutcome.FAILED})
    again = CommissioningProgress.resumed(STEPS, first.results)
    assert walk(again, {}) == ["gate", "late"]
    assert walk(CommissioningProgress.resumed(STEPS, again.results), {}) == []


def test_worst_outcome_of_an_operation_counts_and_nothing_left_out_hides_a_pass() -> None:
    progress = CommissioningProgress(STEPS)
    walk(progress, {"late": CheckOutcome.SKIPPED})
    assert progress.operations() == {"scan": "passed"}
    progress.results["late"] = CheckResult("late", "late", CheckOutcome.FAILED)
    assert progress.operations() == {"scan": "mismatch"}


def test_steps_without_a_pass_are_named_with_the_blocked_ones() -> None:
    progress = CommissioningProgress(STEPS)
    walk(progress, {"gate": CheckOutcome.DECLINED})
    assert progress.not_done() == ["declined: gate", "not tried, since they need those: scan, late"]
    assert CommissioningProgress(STEPS).not_done() == []


def test_nothing_acts_on_the_microscope_before_the_tip_is_withdrawn() -> None:
    steps = {one.name: one for one in all_steps()}

    def needs(name: str) -> set[str]:
        return set(steps[name].after).union(*(needs(other) for other in steps[name].after))

    for one in steps.values():
        if one.moves:
            assert "withdrawn" in needs(one.name)
        if one.contact:
            assert {"contact", "scan", "stop"} <= needs(one.name)
    assert {operation for one in steps.values() for operation in one.operations} == set(OPERATIONS)


def test_resumed_commissioning_stops_at_a_declined_gate() -> None:
    first = CommissioningProgress(STEPS)
    walk(first, {"late": CheckOutcome.FAILED})
    again = CommissioningProgress.resumed(STEPS, first.results)
    assert walk(again, {"gate": CheckOutcome.DECLINED}) == ["gate"]
    assert again.results["late"].outcome is CheckOutcome.BLOCKED
