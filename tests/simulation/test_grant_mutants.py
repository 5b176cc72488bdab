"""The watchman can find something: guards broken on purpose let a request through within a few attacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from rotation import rotated

from afspm.model import ControlRequest, Grant, Request, Response
from afspm.scheduler.control import arbitration
from afspm.scheduler.control.arbitration import ArbitrationEvent, Rules
from afspm.scheduler.control.holder_timeout import Lease
from afspm.scheduler.requests import approvals
from afspm.scheduler.safety import parameter_values
from afspm.scheduler.safety.grants import GrantChecker, HeldGrant
from afspm.scheduler.saved_state import SavedState
from afspm.scheduler.scheduler_core import SchedulerCore
from tests.simulation.grant_attacks import Attack
from tests.simulation.grant_rig import STOPS, AgentViolation

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
Patch = pytest.MonkeyPatch
ATTACKS, CALLS = 200, 250


def _nothing(*args: Any, **given: Any) -> str:
    return ""


def grant_is_not_checked_on_set(patch: Patch) -> None:
    real = GrantChecker._refused_by_grant

    def refused(self: GrantChecker, held: HeldGrant, who: str, request: Request, *rest: Any) -> str:
        return "" if request.kind == ControlRequest.PARAM else real(self, held, who, request, *rest)

    patch.setattr(GrantChecker, "_refused_by_grant", refused)


def any_request_is_the_next_step(patch: Patch) -> None:
    patch.setattr(GrantChecker, "_refused_by_plan", _nothing)


def stop_is_a_step_of_a_plan(patch: Patch) -> None:
    real = GrantChecker._refused_by_plan

    def refused(self: GrantChecker, held: HeldGrant, request: Request, *rest: Any) -> str:
        return "" if request.subject in STOPS else real(self, held, request, *rest)

    patch.setattr(GrantChecker, "_refused_by_plan", refused)


def approved_plan_is_reusable(patch: Patch) -> None:
    real = GrantChecker.sending

    def sending(self: GrantChecker, *args: Any, **given: Any) -> GrantChecker:
        after = real(self, *args, **given)
        plans = {name: replace(one, step=self.book.plans[name].step) for name, one in after.book.plans.items()}
        return replace(after, book=replace(after.book, plans=plans))

    patch.setattr(GrantChecker, "sending", sending)


def interrupted_plan_goes_on(patch: Patch) -> None:
    real = GrantChecker.control_changed

    def changed(self: GrantChecker, before: Any, after: Any, *rest: Any) -> GrantChecker:
        found = real(self, before, after, *rest)
        if before.mode is after.mode and before.problems == after.problems:
            return replace(found, book=replace(found.book, plans=self.book.plans))
        return found

    patch.setattr(GrantChecker, "control_changed", changed)


def approvals_survive_manual_and_problems(patch: Patch) -> None:
    real = GrantChecker.control_changed

    def changed(self: GrantChecker, *args: Any) -> GrantChecker:
        found = real(self, *args)
        return replace(found, book=replace(found.book, plans=self.book.plans, grants=self.book.grants))

    patch.setattr(GrantChecker, "control_changed", changed)


def stale_preflight_is_approved(patch: Patch) -> None:
    patch.setattr(GrantChecker, "_stale", _nothing)


def grant_never_runs_out(patch: Patch) -> None:
    patch.setattr(HeldGrant, "until_ns", property(lambda self: 2**62))


def uses_are_not_counted(patch: Patch) -> None:
    patch.setattr(HeldGrant, "left", lambda self: self.grant.counts)


def uses_are_not_saved(patch: Patch) -> None:
    real = SchedulerCore.restore

    def restore(self: SchedulerCore, saved: SavedState) -> None:
        unused = {name: replace(one, used={}) for name, one in saved.grants.grants.items()}
        real(self, replace(saved, grants=replace(saved.grants, grants=unused)))

    patch.setattr(SchedulerCore, "restore", restore)


def revoking_has_no_effect(patch: Patch) -> None:
    patch.setattr(GrantChecker, "without", lambda self, agent: self)


def agent_approves_itself(patch: Patch) -> None:
    patch.setattr(Rules, "may_approve", lambda self, who: True)
    real = GrantChecker.refused_at_arrival

    def refused(self: GrantChecker, who: str, request: Request, now_ns: int) -> str:
        return "" if isinstance(request.subject, Grant) else real(self, who, request, now_ns)

    patch.setattr(GrantChecker, "refused_at_arrival", refused)


def agent_may_ask_for_anything(patch: Patch) -> None:
    patch.setattr(GrantChecker, "refused_at_arrival", _nothing)


def role_is_not_checked(patch: Patch) -> None:
    patch.setattr(GrantChecker, "_refused_by_role", _nothing)
    patch.setattr(GrantChecker, "_refused_by_number", lambda *_: ("", None))


def place_is_not_checked_before_a_scan(patch: Patch) -> None:
    patch.setattr(GrantChecker, "_refused_at_place", _nothing)


def not_a_number_is_let_through(patch: Patch) -> None:
    patch.setattr(parameter_values, "_finite", lambda name, value: value)


def repeated_id_is_not_compared(patch: Patch) -> None:
    real = GrantChecker.refused

    def refused(self: GrantChecker, who: str, request: Request, *rest: Any) -> Response | None:
        return None if self._spent(who, request.id) is not None else real(self, who, request, *rest)

    patch.setattr(GrantChecker, "refused", refused)


def nothing_is_checked_when_it_is_sent(patch: Patch) -> None:
    patch.setattr(approvals, "refusal", lambda draft, job: None)


def agent_has_no_lease(patch: Patch) -> None:
    patch.setattr(Lease, "asked_until_s", lambda self: None)


def stop_needs_an_approval(patch: Patch) -> None:
    real = GrantChecker.refused_at_arrival

    def refused(self: GrantChecker, who: str, request: Request, now_ns: int) -> str:
        if request.kind == ControlRequest.ADD_EXP_PRBLM and self.rules.is_agent(who):
            return "" if self.has_approval(who, now_ns) else "no approval"
        return real(self, who, request, now_ns)

    patch.setattr(GrantChecker, "refused_at_arrival", refused)


def stop_leaves_the_others_in_control(patch: Patch) -> None:
    rows = arbitration.TABLE[ArbitrationEvent.FLAG]
    patch.setitem(arbitration.TABLE, ArbitrationEvent.FLAG, (replace(rows[-1], when=arbitration.OTHERWISE, do=()),))


MUTANTS: list[Callable[[Patch], None]] = [
    grant_is_not_checked_on_set,
    any_request_is_the_next_step,
    stop_is_a_step_of_a_plan,
    approved_plan_is_reusable,
    interrupted_plan_goes_on,
    approvals_survive_manual_and_problems,
    stale_preflight_is_approved,
    grant_never_runs_out,
    uses_are_not_counted,
    uses_are_not_saved,
    revoking_has_no_effect,
    agent_approves_itself,
    agent_may_ask_for_anything,
    role_is_not_checked,
    place_is_not_checked_before_a_scan,
    not_a_number_is_let_through,
    repeated_id_is_not_compared,
    nothing_is_checked_when_it_is_sent,
    agent_has_no_lease,
    stop_needs_an_approval,
    stop_leaves_the_others_in_control,
]


@pytest.mark.parametrize("mutant", rotated(MUTANTS, 10), ids=lambda one: one.__name__)
def test_broken_guard_is_found(mutant: Callable[[Patch], None], monkeypatch: Patch) -> None:
    mutant(monkeypatch)
    assert any(map(_is_found, range(ATTACKS)))


def _is_found(seed: int) -> bool:
    try:
        Attack(1000 + seed, loses=0.05, kills=0.01).steps(CALLS)
    except AgentViolation:
        return True
    return False
