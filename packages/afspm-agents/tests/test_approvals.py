"""The review of a plan on the page: what a person approves is what is shown."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from afspm import wire
from afspm.basics import InvalidValue
from afspm.model import Approval, Frame, GrantedCount, GrantedRange, Proposal
from afspm_agents.approval import of_plan, of_table, simulated
from afspm_agents.page.approvals import in_force, in_words, title, waiting
from afspm_agents.page.grant_dialog import GrantFields
from afspm_agents.plan import read_plan

PLAN = read_plan({
    "title": "look <b>here</b>\u202e",
    "steps": [
        {"do": "set", "parameter": "tip-bias-voltage", "value": "0.5 V"},
        {"do": "scan", "center": ["0 nm", "0 nm"], "size": ["1 um", "1 um"], "pixels": [8, 8]},
    ],
})  # fmt: skip
FOUND = {"seconds": 8.0, "harm": {"pressed_m": 2e-9}, "refusals": ["too far"]}


def proposal(preflight: str = json.dumps(FOUND), id_: str = PLAN.id) -> Proposal:
    return Proposal(1, "agent:claude", id_, PLAN.canonical(), preflight)


def test_each_request_is_shown_and_is_in_the_approval() -> None:
    grant, plan = of_plan(proposal(), Frame.TIP, {"run": "r", "now_ns": 1})
    lines = in_words(plan)
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
        of_plan(changed, Frame.TIP, {})


def test_failed_simulation_is_not_shown_as_harmless() -> None:
    failed = proposal(json.dumps({"seconds": None, "harm": None, "error": "no surface", "refusals": ["too far"]}))
    assert simulated(failed) == "Not simulated: no surface. The limits will refuse: too far"
    changes = proposal(json.dumps({"seconds": 90, "harm": {"pressed_m": 2e-9, "tip_changes": 2}}))
    assert "the tip changes 2 times" in simulated(changes)


@pytest.mark.parametrize("text", ["no JSON", "[" * 100_000, "7"])
def test_unreadable_proposal_is_shown_without_an_error(text: str) -> None:
    assert title(replace(proposal(), plan=text)) == ""
    assert waiting(replace(proposal(), plan=text))[1] == f"proposes {PLAN.id}"
    assert waiting(proposal(text))[2] == "Its own preflight: Not simulated: the preflight can't be read."


def test_approval_in_force_shows_its_person_and_its_end() -> None:
    plan = Approval("agent:claude", "abc", "dashboard:Ada", 0, steps_left=3)
    agent, what, details = in_force(plan)
    assert (agent, what) == ("agent:claude", "may carry out plan abc: 3 requests left")
    assert details.startswith("approved by Ada until 19")


def test_grant_in_force_shows_its_box_and_its_uses() -> None:
    grant = Approval(
        "agent:claude", "", "dashboard:Ada", 0, left=(GrantedCount("start-scan", 17),),
        region_m=(0.0, 0.0, 2e-6, 1e-6), ranges=(GrantedRange("tip-bias-voltage", -0.5, 0.5),),
        counts=(GrantedCount("start-scan", 20),),
    )  # fmt: skip
    _, what, details = in_force(grant)
    assert what == "may measure by itself, start-scan: 3 of 20 used"
    assert details.startswith("2 × 1 µm at (0, 0) nm; tip-bias-voltage -500 mV to 500 mV; approved by Ada")


def test_waiting_proposal_names_its_agent_its_requests_and_its_simulation() -> None:
    agent, what, details = waiting(proposal())
    assert agent == "agent:claude"
    assert what.startswith("waits for your approval: “look <b>here</b>\\u202e”: set tip-bias-voltage to 0.5 V; ")
    assert details == f"Its own preflight: {simulated(proposal())}"


FIELDS = GrantFields(
    agent="agent:claude",
    lasts="2 h",
    x=("-1 um", "1 um"),
    y=("-1 um", "1 um"),
    ranges=[("tip-bias-voltage", "-0.5 V", "0.5 V"), ("", "", "")],
    counts={"start-scan": "20", "start-spec": "0", "x-pulse": "0"},
)


def test_fields_of_the_dialog_are_the_table_of_the_command_line() -> None:
    assert FIELDS.table() == {
        "agent": "agent:claude",
        "for": "2 h",
        "region": {"x": ["-1 um", "1 um"], "y": ["-1 um", "1 um"]},
        "parameters": {"tip-bias-voltage": ["-0.5 V", "0.5 V"]},
        "counts": {"start-scan": 20},
    }
    grant = of_table(FIELDS.table(), {"run": "r", "limits": "l", "now_ns": 1})
    assert grant.region_m == (0.0, 0.0, 2e-6, 2e-6)
    assert grant.counts == (GrantedCount("start-scan", 20),)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"counts": {"start-scan": "many"}}, "not a whole number"),
        ({"counts": {"start-scan": "-1"}}, "not a whole number"),
        ({"counts": {"start-scan": "0"}}, "without any action"),
        ({"ranges": [("", "1 V", "2 V")]}, "no name"),
        ({"ranges": [("scan-speed", "", "2 um/s")]}, "a lowest and a highest value"),
        ({"ranges": [("scan-speed", "1 um/s", "2 um/s")] * 2}, "named twice"),
        ({"x": ("", "")}, "a lowest and a highest value"),
    ],
)
def test_incomplete_fields_are_refused(wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(InvalidValue, match=why):
        replace(FIELDS, **wrong).table()
