"""A plan: strict, with one canonical form, and the requests that a person approves."""

from __future__ import annotations

import json
from typing import Any

import pytest

from afspm import wire
from afspm.basics import InvalidValue
from afspm.model import Frame, Proposal, Region, ScanParameters
from afspm_agents import commands
from afspm_agents.approval import of_plan, of_table, simulated
from afspm_agents.plan import plan_of, read_plan, read_step

SCAN = {"do": "scan", "center": ["10 nm", "0 nm"], "size": ["500 nm", "0.5 um"], "pixels": [64, 32]}
STEPS = [
    {"do": "set", "parameter": "tip-bias-voltage", "value": "500 mV"},
    SCAN,
    {"do": "move", "to": ["-1 um", "0 nm"]},
    {"do": "spectrum", "at": ["0 nm", "20 nm"]},
]
NO_PLANS = [
    "no JSON",
    "[" * 100_000,
    '{"title":7,"steps":[]}',
    '{"title":"t","steps":[{"do":"move","to_m":5}]}',
    '{"title":"t","steps":[{"do":"move","to_m":[1' + "0" * 400 + ",0]}]}",
]
FACTS = {"run": "night", "limits": "abc", "offset_m": None, "now_ns": 5}


def plan(*steps: Any, title: str = "t") -> Any:
    return read_plan({"title": title, "steps": list(steps or STEPS)})


def test_same_plan_in_other_units_has_the_same_id() -> None:
    other = {**SCAN, "center": ["0.01 um", "0 m"], "size": ["0.5 um", "500 nm"], "angle": "0 rad"}
    assert plan(SCAN).id == plan(other).id
    assert plan(SCAN).id != plan({**SCAN, "pixels": [32, 64]}).id
    assert plan(SCAN).id != plan(SCAN, title="u").id


def test_canonical_form_gives_the_plan_back() -> None:
    one = plan()
    assert plan_of(one.canonical()) == one
    assert plan_of(plan_of(one.canonical()).canonical()).id == one.id


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", '{"title":"t","steps":[{"do":"jump"}]}', '{ "title":"t","steps":[]}', *NO_PLANS]
)
def test_other_text_is_no_canonical_form(text: str) -> None:
    with pytest.raises(InvalidValue):
        plan_of(text)


def test_canonical_form_with_an_added_field_is_refused() -> None:
    facts = json.loads(plan(SCAN).canonical())
    facts["steps"][0]["force"] = True
    with pytest.raises(InvalidValue):
        plan_of(json.dumps(facts, sort_keys=True, separators=(",", ":")))


@pytest.mark.parametrize(
    "wrong",
    [
        {**SCAN, "center": ["10", "0 nm"]},
        {**SCAN, "center": [1e-8, 0.0]},
        {"do": "set", "parameter": "sample-bias", "value": "500 mV"},
        {**SCAN, "center": ["nan nm", "0 nm"]},
        {**SCAN, "center": ["inf nm", "0 nm"]},
        {**SCAN, "center": ["10 V", "0 nm"]},
        {**SCAN, "center": "10 nm"},
        {**SCAN, "center": ["2 m", "0 m"]},
        {**SCAN, "size": ["0 nm", "1 nm"]},
        {**SCAN, "size": ["-1 nm", "1 nm"]},
        {**SCAN, "pixels": [True, 2]},
        {**SCAN, "pixels": [1.0, 2]},
        {**SCAN, "pixels": ["1", "2"]},
        {**SCAN, "pixels": [10**6, 2]},
        {**SCAN, "force": True},
        {"do": "scan"},
        {"do": "set", "parameter": "tip-bias-voltage", "value": "0.5"},
        {"do": "set", "parameter": "tip-bias-voltage", "value": "nan"},
        {"do": "set", "parameter": "tip-bias-voltage", "value": 0.5},
        {"do": "set", "parameter": "tip bias", "value": "0.5 V"},
        {"do": "set", "parameter": "x", "value": "a\u202eb"},
        {"do": "action", "name": "x-crash"},
        None,
        "scan",
    ],
)
def test_wrong_step_is_refused(wrong: Any) -> None:
    with pytest.raises(InvalidValue):
        read_step(wrong)


def test_requests_are_the_bytes_that_are_sent() -> None:
    requests = plan().requests(Frame.TIP)
    assert [one.text.split(" ")[0] for one in requests] == ["set", "place:", "scan", "move", "move", "spectrum"]
    sent = wire.decode_request([bytes([requests[1].kind]), requests[1].step.payload])
    assert isinstance(sent.subject, ScanParameters)
    assert sent.subject.shape == (64, 32)
    assert isinstance(sent.subject.region, Region)
    assert sent.subject.region.center_m == pytest.approx((10e-9, 0.0))


def test_approval_of_a_plan_is_that_plan() -> None:
    one = plan()
    of_its_server = json.dumps({"facts": {**FACTS, "now_ns": 9, "limits": "its own"}})
    grant, shown = of_plan(Proposal(1, "agent:claude", one.id, one.canonical(), of_its_server), Frame.TIP, FACTS)
    assert (grant.plan, grant.run, grant.limits, grant.since_ns, len(grant.steps)) == (one.id, "night", "abc", 5, 6)
    assert grant.drift_m == pytest.approx(50e-9)
    assert shown == one


@pytest.mark.parametrize("change", [{"id": "0" * 16}, {"preflight": ""}])
def test_proposal_with_another_hash_or_without_preflight_is_not_approved(change: dict[str, str]) -> None:
    one = plan()
    fields = {"id": one.id, "plan": one.canonical(), "preflight": json.dumps({"seconds": 1.0}), **change}
    with pytest.raises(InvalidValue):
        of_plan(Proposal(1, "agent:claude", **fields), Frame.TIP, FACTS)


@pytest.mark.parametrize("preflight", ["no JSON", "[]", "[" * 100_000, '{"harm":[1],"seconds":1}'])
def test_unreadable_preflight_is_shown_as_such(preflight: str) -> None:
    one = plan()
    proposal = Proposal(1, "agent:claude", one.id, one.canonical(), preflight)
    assert simulated(proposal).startswith("Not simulated: ")


@pytest.mark.parametrize("text", NO_PLANS)
def test_unreadable_plan_is_listed_beside_the_others(
    text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = plan(title="look")
    listed = [Proposal(1, "agent:rival", "a" * 16, text), Proposal(2, "agent:claude", one.id, one.canonical())]
    monkeypatch.setattr(commands, "_proposals", lambda where: listed)
    commands.approve("")
    bad, good = capsys.readouterr().out.splitlines()
    assert "can't be approved, its plan can't be read" in bad
    assert good == f'{one.id}  agent:claude  has no preflight  "look"'


def test_grant_of_a_table() -> None:
    table = {
        "agent": "agent:claude", "for": "2 h", "region": {"x": ["-1 um", "3 um"], "y": ["0 um", "1 um"]},
        "parameters": {"tip-bias-voltage": ["-500 mV", "0.5 V"]}, "counts": {"start-scan": 3},
    }  # fmt: skip
    grant = of_table(table, FACTS)
    assert grant.region_m == pytest.approx((1e-6, 0.5e-6, 4e-6, 1e-6))
    assert (grant.ranges[0].low, grant.ranges[0].high, grant.lasts_s) == (-0.5, 0.5, 7200.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"for": 2},
        {"for": "2"},
        {"for": "0 s"},
        {"counts": {"start-scan": True}},
        {"parameters": {"magnet.field": ["-1", "1"]}},
        {"counts": {"start-scan": 1.5}},
        {"region": {"x": ["0 um", "1 um"]}},
        {"region": {"x": ["1 um", "0 um"], "y": ["0 um", "1 um"]}},
        {"parameters": {"tip-bias-voltage": [0.1, 0.2]}},
        {"parameters": {"tip-bias-voltage": ["1 V", "0 V"]}},
        {"parameters": {"tip-bias-voltage": ["-5", "5 V"]}},
        {"treatments": 1},
    ],
)
def test_wrong_grant_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValue):
        of_table({"agent": "agent:claude", "for": "2 h", **wrong}, FACTS)
