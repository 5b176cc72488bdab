"""Decisions about forbidden states, broken on purpose."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import pytest

from afspm.model import Parameter, ScanParameters
from afspm.model.microscope_status import MicroscopeStatus
from afspm.scheduler.instruments.known_instruments import Instruments
from afspm.scheduler.requests import instrument_requests
from afspm.scheduler.safety import forbidden_states, present_state, rule_language
from afspm.scheduler.safety.forbidden_states import PresentState
from afspm.scheduler.safety.limit_checker import LimitChecker
from afspm.scheduler.scheduler_core import SchedulerCore
from afspm.scheduler.state import StateDraft

Patch = pytest.MonkeyPatch


def forbidden_states_are_not_looked_at(patch: Patch) -> None:
    patch.setattr(LimitChecker, "check_forbidden", lambda self, request, present: None)


def an_unknown_value_is_allowed(patch: Patch) -> None:
    real = forbidden_states.refusal
    patch.setattr(forbidden_states, "refusal", lambda *args: real(*args, certain=True))


def every_request_moves_away(patch: Patch) -> None:
    patch.setattr(forbidden_states._Decision, "_moves_away", lambda self: True)


def one_value_that_moves_away_excuses_the_others(patch: Patch) -> None:
    def moves_away(self: Any) -> bool:
        for atom in rule_language.atoms(self.rule.tree):
            steps = [(atom.excess(known), atom.excess({**known, **self.settings})) for known in self.before]
            if all(was is not None and now is not None and now < was for was, now in steps):
                return True
        return False

    patch.setattr(forbidden_states._Decision, "_moves_away", moves_away)


def values_are_not_read(patch: Patch) -> None:
    """The last values seen count, which a request of unknown outcome has changed."""

    def remembered(draft: StateDraft, read: Mapping[str, Parameter | None]) -> PresentState:
        return real(draft, draft.limits.state.last_seen)

    real = present_state.present_state
    patch.setattr(present_state, "present_state", remembered)
    patch.setattr(forbidden_states, "to_read", lambda rules: [])


def orders_are_decided_without_the_microscope(patch: Patch) -> None:
    """The last values seen count, while a command is in flight."""
    real = present_state.present_state
    patch.setattr(instrument_requests, "_has_read", lambda draft, instrument: True)
    patch.setattr(instrument_requests, "present_state", lambda draft, read: real(draft, draft.limits.state.last_seen))


def values_read_for_an_order_stay_good(patch: Patch) -> None:
    patch.setattr(Instruments, "without_reads", lambda self, names: self)


def orders_given_are_forgotten(patch: Patch) -> None:
    real = Instruments.handed_out
    patch.setattr(Instruments, "handed_out", lambda self, *order: replace(real(self, *order), given=self.given))


def orders_given_are_not_saved(patch: Patch) -> None:
    real = SchedulerCore.restore
    patch.setattr(SchedulerCore, "restore", lambda self, saved: real(self, replace(saved, given_orders=())))


def a_target_is_not_looked_at(patch: Patch) -> None:
    real = Instruments.candidates

    def candidates(self: Instruments, parameter: str, now_s: float) -> Any:
        found = real(self, parameter, now_s)
        return found if isinstance(found, str) else found[:1]

    patch.setattr(Instruments, "candidates", candidates)


def a_scan_counts_once_it_is_published(patch: Patch) -> None:
    patch.setattr(MicroscopeStatus, "expecting", lambda self, *states, until_s: self)


def the_settings_of_an_action_are_not_looked_at(patch: Patch) -> None:
    real = forbidden_states.changed_by

    def changed_by(limits: Any, request: Any) -> dict[str, Parameter]:
        return {} if isinstance(request.subject, str) else real(limits, request)

    patch.setattr(forbidden_states, "changed_by", changed_by)


def frames_are_not_looked_at(patch: Patch) -> None:
    real = forbidden_states.values_in

    def values_in(subject: object) -> dict[str, Parameter]:
        return {} if isinstance(subject, ScanParameters) else real(subject)

    patch.setattr(forbidden_states, "values_in", values_in)


def a_stop_is_refused(patch: Patch) -> None:
    patch.setattr(forbidden_states, "NEVER_REFUSED", frozenset())


def amounts_have_a_sign(patch: Patch) -> None:
    patch.setattr(
        rule_language.RuleTerm, "value", lambda self, known: known.get(self.name) if self.name else self.number
    )


def a_junction_of_one_kind(patch: Patch) -> None:
    """`or` is read as `and`."""
    real = rule_language.holds

    def holds(tree: Any, known: Any, false: Collection[Any] = ()) -> bool | None:
        if isinstance(tree, rule_language.RuleJunction):
            tree = rule_language.RuleJunction(tree.parts, is_any=False)
        return real(tree, known, false)

    patch.setattr(rule_language, "holds", holds)


MUTANTS = [
    forbidden_states_are_not_looked_at,
    an_unknown_value_is_allowed,
    every_request_moves_away,
    one_value_that_moves_away_excuses_the_others,
    values_are_not_read,
    orders_are_decided_without_the_microscope,
    values_read_for_an_order_stay_good,
    orders_given_are_forgotten,
    orders_given_are_not_saved,
    a_target_is_not_looked_at,
    a_scan_counts_once_it_is_published,
    the_settings_of_an_action_are_not_looked_at,
    frames_are_not_looked_at,
    a_stop_is_refused,
    amounts_have_a_sign,
    a_junction_of_one_kind,
]
