"""The state of microscope and instruments that a request is judged in by the forbidden states."""

from __future__ import annotations

from collections.abc import Mapping

from afspm.model import Parameter, Request
from afspm.model.instruments import instrument_of
from afspm.scheduler.safety import rule_language
from afspm.scheduler.safety.forbidden_states import STATES, PresentState, in_states, judging
from afspm.scheduler.state import StateDraft

_NOT_READ = "the microscope reports no value now"


def present_state(draft: StateDraft, read: Mapping[str, Parameter | None]) -> PresentState:
    """Return the present state, with values read from the microscope for this decision.

    Values that were not read for this decision are unknown: a person may have changed them since.
    """
    values: dict[str, tuple[Parameter, ...]] = {name: (one,) for name, one in read.items() if one is not None}
    unknown = dict[str, str]()
    wanted = frozenset[str]().union(*(rule.names for rule in draft.limits.limits.forbid.values()))
    states = draft.microscope.possible_states(draft.now_s)
    if states:
        values |= in_states(states)
    for name in wanted - values.keys():
        if rule_language.changed_name(name):
            continue
        if name in STATES:
            unknown[name] = "the microscope has not reported its state"
        elif draft.instruments.owns(name):
            found = draft.instruments.candidates(name, draft.now_s)
            if isinstance(found, str):
                unknown[name] = found
            else:
                values[name] = found
        elif instrument_of(name):
            unknown[name] = f"there is no instrument {instrument_of(name)}"
        else:
            unknown[name] = _NOT_READ
    return PresentState(values, unknown)


def sending(draft: StateDraft, request: Request) -> None:
    """Forget values that were read for waiting orders of instruments, if a request may change them."""
    if names := {name for rule in judging(draft.limits.limits, request) for name in rule.names}:
        draft.instruments = draft.instruments.without_reads(names)
