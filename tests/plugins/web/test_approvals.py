"""The review of a plan on the page: what a person approves is what is shown."""

from __future__ import annotations

import json

import pytest

from afspm import wire
from afspm.basics.errors import InvalidValue
from afspm.model import Approval, GrantedCount, Proposal
from afspm.plugins.agent.approval import simulated
from afspm.plugins.agent.plan import read_plan
from afspm.plugins.web.dashboard.approvals import in_force, reviewed, title

PLAN = read_plan({
    "title": "look <b>here</b>\u202e",
    "steps": [
        {"do": "set", "parameter": "tip-bias-voltage", "value": "0.5 V"},
        {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["1 um", "1 um"], "pixels": [8, 8]},
    ],
})  # fmt: skip
FOUND = {"seconds": 8.0, "harm": {"pressed_m": 2e-9}, "refusals": ["too far"], "facts": {"run": "r", "now_ns": 1}}


def proposal(preflight: str = json.dumps(FOUND), id_: str = PLAN.id) -> Proposal:
    return Proposal(1, "agent:claude", id_, PLAN.canonical(), preflight)


def test_each_request_is_shown_and_is_in_the_approval() -> None:
    grant, lines = reviewed(proposal())
    assert len(lines) == len(grant.steps) == 3
    assert lines[0] == "set tip-bias-voltage to 0.5 V"
    sent = wire.decode_request([bytes([grant.steps[0].request]), grant.steps[0].payload])
    assert sent.subject.value == "0.5"


def test_title_is_escaped_and_the_simulation_is_in_words() -> None:
    assert title(proposal()) == "look <b>here</b>\\u202e"
    assert simulated(proposal()) == (
        "Simulated: 8 s; pressed at most 2 nm into the sample. The limits will refuse: too far"
    )


@pytest.mark.parametrize("changed", [proposal(""), proposal(id_="f" * 16)])
def test_plan_without_preflight_or_with_another_hash_is_not_reviewed(changed: Proposal) -> None:
    with pytest.raises(InvalidValue):
        reviewed(changed)


def test_failed_simulation_is_not_shown_as_harmless() -> None:
    failed = proposal(json.dumps({"seconds": None, "harm": None, "error": "no surface", "refusals": ["too far"]}))
    assert simulated(failed) == "Not simulated: no surface. The limits will refuse: too far"
    changes = proposal(json.dumps({"seconds": 90, "harm": {"pressed_m": 2e-9, "tip_changes": 2}}))
    assert "the tip changes 2 times" in simulated(changes)


def test_approval_in_force_shows_its_person_and_its_end() -> None:
    plan = Approval("agent:claude", "abc", "dashboard:Ada", 0, steps_left=3)
    assert "agent:claude may carry out plan abc, 3 requests left; approved by Ada until 19" in in_force(plan)
    grant = Approval("agent:claude", "", "dashboard:Ada", 0, left=(GrantedCount("start-scan", 20),))
    assert "may measure by itself, left: start-scan: 20; approved by Ada" in in_force(grant)
