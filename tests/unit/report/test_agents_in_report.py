"""The report's table of agents, from a record of proposals, approvals, refusals and stops."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from afspm import wire
from afspm.model import (
    STOPPED_BY_AGENT,
    Approval,
    Approvals,
    ControlMode,
    ControlRequest,
    ControlResponse,
    ControlState,
    GrantedCount,
    GrantedRange,
    JournalEntries,
    JournalEntry,
    Packet,
    Proposal,
    Region,
    Scan,
    ScopeState,
    ScopeStatus,
    names,
)
from afspm.model.problems import HIGHEST_PROBLEM
from afspm.night.run import open_run
from afspm.record.store import RecordSettings, RecordStore
from afspm.report import agents
from afspm.report.night_report import write

S = 1_000_000_000
START = 1_700_000_000 * S
AGENT, ADA = "agent:<claude>", "dashboard:Ada"
UNTIL = START + 7200 * S
PARAM = int(ControlRequest.PARAM)


def grant(left: int) -> Approval:
    return Approval(
        AGENT, "", ADA, UNTIL, left=(GrantedCount(names.START_SCAN, left), GrantedCount(names.PULSE, 0)),
        region_m=(0.0, 1e-6, 2e-6, 1e-6), ranges=(GrantedRange(names.TIP_BIAS_VOLTAGE, -0.5, 0.5),),
        counts=(GrantedCount(names.START_SCAN, 20), GrantedCount(names.PULSE, 0)),
    )  # fmt: skip


def entry(at_s: int, who: str, request: int, response: int, problem: int | None = None) -> JournalEntries:
    return JournalEntries(
        (JournalEntry(START + at_s * S, "request", who, "x", response, request=request, problem=problem),)
    )


def proposal(at_s: int, id_: str, preflight: str = "") -> Proposal:
    return Proposal(START + at_s * S, AGENT, id_, '{"steps":[],"title":"<b>"}', preflight)


def night() -> list[tuple[int, Any]]:
    scan = Scan(Region((0.0, 0.0), (1e-6, 1e-6)), "Height", "m", np.zeros((4, 4)), START + 60 * S, "1.nc")
    refused, done = int(ControlResponse.PARAM_ERROR), int(ControlResponse.SUCCESS)
    flag = int(ControlRequest.ADD_EXP_PRBLM)
    return [
        (1, proposal(1, "a" * 16)),
        (2, proposal(2, "a" * 16, "{}")),
        (3, proposal(3, "b" * 16, "{}")),
        (5, Approvals((Approval(AGENT, "b" * 16, ADA, UNTIL, 2),))),
        (6, Approvals((Approval(AGENT, "b" * 16, ADA, UNTIL, 1),))),
        (10, Approvals((grant(20),))),
        (20, ControlState(ControlMode.AUTOMATED, AGENT)),
        (50, ScopeStatus(ScopeState.SCANNING)),
        (51, Approvals((grant(19),))),
        (60, scan),
        (61, ScopeStatus(ScopeState.FREE)),
        (70, entry(70, AGENT, PARAM, refused)),
        (71, entry(71, AGENT, PARAM, refused)),
        (72, entry(72, "agent:other", PARAM, int(ControlResponse.FAILURE))),
        (73, entry(73, "series", PARAM, refused)),
        (80, entry(80, f"{AGENT} stop", flag, done, HIGHEST_PROBLEM)),
        (81, Approvals()),
    ]


def recorded(folder: Path, packets: list[tuple[int, Any]]) -> Path:
    problems = {STOPPED_BY_AGENT: HIGHEST_PROBLEM}
    (folder / "run.json").write_text(json.dumps({"guest": {"problems": problems}}), encoding="utf-8")
    store = RecordStore(folder, RecordSettings({"experiment": "night"}))
    store.take([(Packet(*wire.encode(thing), START + at_s * S), "") for at_s, thing in packets])
    store.finish()
    store.close()
    return folder


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return recorded(tmp_path, night())


def test_work_of_each_agent_is_counted(run: Path) -> None:
    with open_run(run) as record:
        claude, other = agents.read(record)
    assert (claude.name, claude.proposed, claude.approved, claude.scans, claude.spectra) == (AGENT, 2, 1, 1, 0)
    assert claude.refused == {"param-error": 2}
    assert claude.stops == [START + 80 * S]
    (held,) = claude.grants
    assert (held.approval, held.gone_ns) == (grant(19), START + 81 * S)
    assert (other.name, other.proposed, other.refused, other.grants) == ("agent:other", 0, {"failure": 1}, [])


def test_report_shows_agents_with_box_uses_and_end_of_each_grant(run: Path) -> None:
    text = write(run).read_text(encoding="utf-8")
    table = text[text.index("<h2>Agents</h2>") :].partition("</section>")[0]
    assert "agent:&lt;claude&gt;" in table
    assert "2 × 1 µm at (0, 1) µm; tip-bias-voltage -500 mV to 500 mV; 1 of 20 start-scan; 0 of 0 x-pulse" in table
    assert "ended at" in table
    assert "2 × param-error" in table
    assert "<claude>" not in text


def test_grant_that_ran_out_has_no_other_end(tmp_path: Path) -> None:
    run = recorded(tmp_path, [(10, Approvals((grant(20),))), (7300, Approvals())])
    with open_run(run) as record:
        (claude,) = agents.read(record)
    assert [one.gone_ns for one in claude.grants] == [None]


def test_report_of_a_run_without_agents_does_not_mention_them(tmp_path: Path) -> None:
    others = [(at_s, thing) for at_s, thing in night() if not isinstance(thing, Proposal | Approvals)]
    run = recorded(tmp_path, [one for one in others if one[0] not in (20, 70, 71, 72, 80)])
    with open_run(run) as record:
        assert agents.read(record) == []
    assert "Agents" not in write(run).read_text(encoding="utf-8")
