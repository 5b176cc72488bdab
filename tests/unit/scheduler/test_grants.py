"""Approvals of agents: nothing is sent without one, nothing twice, nothing outside."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from tests.unit.scheduler.logic_lab import Lab, killed, published, replies

from afspm.basics.errors import InvalidValue
from afspm.model import (
    GRANT_REQUEST,
    LEASE_REQUEST,
    RELAY_REQUEST,
    RESTART_REQUEST,
    STOPPED_BY_AGENT,
    Approvals,
    ControlMode,
    ControlRequest,
    ControlResponse,
    Feedback,
    Grant,
    GrantedCount,
    GrantedRange,
    GrantedStep,
    InstrumentOrder,
    InstrumentReading,
    InstrumentReadings,
    Note,
    OrderOutcome,
    Parameter,
    ProbePosition,
    Problem,
    ProblemNames,
    ProcessStates,
    Region,
    RegionChange,
    RelayedMessage,
    Request,
    ScanParameters,
    ScopeState,
    names,
)
from afspm.model.problems import HIGHEST_PROBLEM
from afspm.scheduler.control.arbitration import RoleTable
from afspm.scheduler.events import Forward, Tick
from afspm.scheduler.instruments.conditions import InstrumentSettings
from afspm.scheduler.safety.grants import GrantChecker, limits_digest
from afspm.scheduler.safety.limit_state import LimitState
from afspm.scheduler.safety.limits import ExperimentLimits, Limit, RoleLimits
from afspm.scheduler.settings import ControlSettings, RunFacts, SchedulerSettings

AGENT, ADA, STOP = "agent:claude", "dashboard:Ada", HIGHEST_PROBLEM
OK, REFUSED = ControlResponse.SUCCESS, ControlResponse.FAILURE
UM, NO_ID = 1e-6, "none"
HERE = Region((0.0, 0.0), (0.5 * UM, 0.5 * UM))
FAR = Region((3 * UM, 0.0), (0.5 * UM, 0.5 * UM))
ACTION, PARAM, SCAN = int(ControlRequest.ACTION), int(ControlRequest.PARAM), int(ControlRequest.SET_SCAN_PARAMS)
LIMITS = ExperimentLimits(parameters={names.TIP_BIAS_VOLTAGE: Limit(-5.0, 5.0, unit="V")})
ROLE = RoleLimits(
    ExperimentLimits(
        parameters={names.TIP_BIAS_VOLTAGE: Limit(-1.0, 1.0, unit="V")}, region=Region((0.0, 0.0), (4 * UM, 4 * UM))
    ),
    parameters_only=True,
    actions=(names.START_SCAN,),
    per_hour={names.START_SCAN: 4},
)


def settings(limits: ExperimentLimits = LIMITS) -> SchedulerSettings:
    roles = RoleTable(operate=("dashboard",), approve=("dashboard",))
    control = ControlSettings(agents=("agent",), roles=roles)
    rules = control.rules(ProblemNames({STOPPED_BY_AGENT: STOP}))
    return SchedulerSettings(control=control, rules=rules, limits=limits, run=RunFacts(name="night"))


class AgentLab:
    """A scheduler with an agent, a person and a microscope that answers every request."""

    def __init__(self, limits: ExperimentLimits = LIMITS) -> None:
        self.settings = settings(limits)
        self.lab = Lab(self.settings)
        self.lab.translator()
        self.place: Region = FAR
        self.in_force: dict[str, Any] = {}
        self.ids = 0

    def grant(self, **changes: Any) -> Grant:
        given = {
            "region_m": (0.0, 0.0, 2 * UM, 2 * UM),
            "ranges": (GrantedRange(names.TIP_BIAS_VOLTAGE, -0.5, 0.5),),
            "counts": (GrantedCount(names.START_SCAN, 2),),
        }
        return replace(self.approval(), **{**given, **changes})

    def approval(self, **changes: Any) -> Grant:
        fresh = Grant(
            AGENT, lasts_s=1800.0, run="night", limits=limits_digest(self.settings.limits), since_ns=self.lab.now_ns - 1
        )
        return replace(fresh, **changes)

    def plan(self, *wanted: tuple[int, Any], **changes: Any) -> Grant:
        steps = tuple(GrantedStep(kind, self.lab.codec.encode(subject)) for kind, subject in wanted)
        return replace(self.approval(), plan="abc", steps=steps, **changes)

    def give(self, grant: Grant, by: str = ADA) -> ControlResponse:
        return self.lab.says(by, GRANT_REQUEST, grant)

    def do(
        self, kind: int, subject: Any = None, id_: str = "", answers: ControlResponse | None = OK, who: str = AGENT
    ) -> str:
        """Send a request of the agent: the reason of its refusal; "" if the microscope got it."""
        self.ids += 1
        before = len(self.lab.forwarded)
        effects = self.lab.ask(who, kind, subject, "" if id_ == NO_ID else id_ or f"{who}/1/{self.ids}")
        left, low = (self.place.center_m[i] - self.place.size_m[i] / 2 for i in (0, 1))
        effects += self.lab.answer_reads(
            scan_size_x=str(self.place.size_m[0]), scan_size_y=str(self.place.size_m[1]),
            scan_top_left_x=str(left), scan_top_left_y=str(low), scan_angle="0",
            **{"probe_pos_x": "0", "probe_pos_y": "0", **self.in_force},
        )  # fmt: skip
        new = [one for one in self.lab.forwarded[before:] if (one.request.kind, one.request.subject) == (kind, subject)]
        if new and answers is not None:
            if isinstance(subject, ScanParameters) and isinstance(subject.region, Region) and answers is OK:
                self.place = subject.region
            self.lab.answer(new[-1], answers)
        if new:
            return ""
        return replies(effects)[-1].response.reason or "refused"

    def begin(self, *grants: Grant) -> AgentLab:
        for grant in grants:
            assert self.give(grant) is OK
        assert self.lab.take_control(AGENT) is OK
        return self


@pytest.fixture
def agent() -> AgentLab:
    return AgentLab()


def sent(lab: Lab, of: int = ACTION) -> list[Forward]:
    return [one for one in lab.forwarded if one.request.kind == of]


# --- without an approval --------------------------------------------------------------------------------------------


def test_agent_without_approval_gets_no_control_and_no_command(agent: AgentLab) -> None:
    assert agent.lab.take_control(AGENT) is REFUSED
    assert "has no approval" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"))
    assert agent.lab.holder is None


def test_agent_reads_without_an_approval(agent: AgentLab) -> None:
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE), answers=None) == ""


@pytest.mark.parametrize(
    ("kind", "subject"),
    [
        (ControlRequest.SET_CONTROL_MODE, int(ControlMode.MANUAL)),
        (ControlRequest.END_EXPERIMENT, None),
        (RESTART_REQUEST, "recorder"),
        (ControlRequest.RMV_EXP_PRBLM, int(Problem.TIP_SHAPE_CHANGED)),
        (ControlRequest.ADD_EXP_PRBLM, int(Problem.TIP_SHAPE_CHANGED)),
        (ControlRequest.REQUEST_CTRL, int(Problem.TIP_SHAPE_CHANGED)),
        (LEASE_REQUEST, 3600.0),
    ],
)
def test_agent_does_nothing_that_only_a_person_does(agent: AgentLab, kind: int, subject: Any) -> None:
    agent.begin(agent.grant())
    assert agent.lab.says(AGENT, kind, subject, "agent:claude/1/x") is REFUSED
    assert agent.lab.holder == AGENT


def test_agent_relays_its_notes_but_no_reports_of_processes(agent: AgentLab) -> None:
    note = Note(agent.lab.now_ns, AGENT, "clean island", None, agent.lab.now_ns)
    assert agent.lab.says(AGENT, RELAY_REQUEST, RelayedMessage("Note", agent.lab.codec.encode(note))) is OK
    states = ProcessStates(agent.lab.now_ns, "supervisor", ())
    relayed = RelayedMessage("ProcessStates", agent.lab.codec.encode(states))
    assert agent.lab.says(AGENT, RELAY_REQUEST, relayed) is REFUSED


@pytest.mark.parametrize("by", [AGENT, "agent", "agent:other", "series", "gateway:Ada"])
def test_only_a_person_with_the_role_approves(agent: AgentLab, by: str) -> None:
    assert agent.give(agent.grant(), by) is REFUSED
    assert agent.give(agent.grant(), ADA) is OK


def test_agent_never_has_the_role_approve() -> None:
    agent = AgentLab()
    roles = RoleTable(approve=("agent", "agent:claude", "agent:other"))
    agent.settings = replace(agent.settings, rules=replace(agent.settings.rules, roles=roles))
    agent.lab = Lab(agent.settings)
    assert agent.give(agent.grant(), "agent:other") is REFUSED


def test_only_an_agent_is_approved(agent: AgentLab) -> None:
    assert agent.give(agent.grant(agent="series")) is REFUSED


# --- stale approvals ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"run": "yesterday"},
        {"limits": "other"},
        {"since_ns": 0},
        {"offset_m": (0.0, 0.0), "drift_m": 1e-9},
    ],
)
def test_stale_approval_is_refused(agent: AgentLab, changes: dict[str, Any]) -> None:
    assert agent.give(agent.grant(**changes)) is REFUSED


def test_drift_makes_a_plan_stale_and_no_grant(agent: AgentLab) -> None:
    checker = GrantChecker(agent.settings.rules, agent.settings.limits, "night")
    now_ns, place = agent.lab.now_ns, {"offset_m": (0.0, 0.0), "drift_m": 1e-9}
    plan = agent.plan((PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V")), **place)
    assert checker.given(ADA, plan, now_ns, (0.9e-9, 0.0))[1] == ""
    assert "drifted by 1.1 nm" in checker.given(ADA, plan, now_ns, (1.1e-9, 0.0))[1]
    grant = agent.grant(offset_m=(0.0, 0.0))
    assert checker.given(ADA, grant, now_ns, (20e-9, 0.0))[1] == ""
    assert "not known" in checker.given(ADA, grant, now_ns, (math.nan, 0.0))[1]


def test_drift_after_the_approval_refuses_the_next_step_of_a_plan(agent: AgentLab) -> None:
    now_ns, bias = agent.lab.now_ns, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V")
    plan = agent.plan((PARAM, bias), (SCAN, ScanParameters(HERE)), offset_m=(0.0, 0.0), drift_m=1e-9)
    checker, why = GrantChecker(agent.settings.rules, agent.settings.limits, "night").given(
        ADA, plan, now_ns, (0.0, 0.0)
    )
    assert why == ""
    first, second = (
        Request(kind, subject, agent.lab.codec.encode(subject), f"{AGENT}/1/{kind}")
        for kind, subject in ((PARAM, bias), (SCAN, ScanParameters(HERE)))
    )
    assert checker.refused(AGENT, first, now_ns, (0.9e-9, 0.0), LimitState()) is None
    checker = checker.sending(AGENT, first, now_ns, (0.9e-9, 0.0)).done(AGENT, first)
    assert checker.refused(AGENT, second, now_ns, (0.9e-9, 0.0), LimitState()) is None
    refusal = checker.refused(AGENT, second, now_ns, (1.1e-9, 0.0), LimitState())
    assert refusal is not None
    assert "drifted by 1.1 nm" in refusal.reason


@pytest.mark.parametrize("disturb", ["problem", "manual"])
def test_preflight_before_a_problem_or_manual_is_stale(agent: AgentLab, disturb: str) -> None:
    approval = agent.grant()
    if disturb == "problem":
        agent.lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
        agent.lab.clear("classifier", Problem.TIP_SHAPE_CHANGED)
    else:
        agent.lab.mode(ADA, ControlMode.MANUAL)
        agent.lab.mode(ADA, ControlMode.AUTOMATED)
    assert agent.give(approval) is REFUSED
    agent.lab.later(experiment_s=1.0)
    assert agent.give(agent.grant()) is OK


def test_problem_ends_a_plan_and_leaves_a_grant(agent: AgentLab) -> None:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    agent.begin(agent.grant(), agent.plan((PARAM, bias)))
    agent.lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    agent.lab.clear("classifier", Problem.TIP_SHAPE_CHANGED)
    assert agent.lab.take_control(AGENT) is OK
    assert "(the grant)" in agent.do(PARAM, bias)
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.4", "V")) == ""


def test_problem_that_a_person_solves_ends_all_approvals(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    agent.lab.flag("classifier", Problem.DEVICE_MALFUNCTION)
    agent.lab.clear(ADA, Problem.DEVICE_MALFUNCTION)
    assert agent.lab.core.state.grants.book.approvals() == Approvals()
    assert agent.lab.take_control(AGENT) is REFUSED


def test_manual_ends_all_approvals(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    agent.lab.mode(ADA, ControlMode.MANUAL)
    agent.lab.mode(ADA, ControlMode.AUTOMATED)
    assert agent.lab.take_control(AGENT) is REFUSED


def test_approval_ends_with_its_time(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=60.0))
    agent.lab.later(experiment_s=61.0)
    assert "no approval" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"))


def test_control_and_scan_end_with_the_time_of_the_approval(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=60.0))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    due_ns = agent.lab.core.deadline_ns()
    assert due_ns is not None
    assert agent.lab.now_ns < due_ns <= agent.lab.now_ns + 60 * 10**9
    agent.lab.later(experiment_s=59.0)
    agent.lab.step(Tick())
    assert agent.lab.holder == AGENT
    agent.lab.later(experiment_s=2.0)
    agent.lab.step(Tick())
    assert agent.lab.holder is None
    assert sent(agent.lab)[-1].request.subject == names.STOP_SCAN
    assert agent.lab.core.state.grants.book.approvals() == Approvals()
    assert agent.lab.core.deadline_ns() is None


def test_agent_keeps_control_while_another_approval_is_in_force(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=60.0))
    assert agent.give(plan_of(agent)) is OK
    agent.lab.later(experiment_s=61.0)
    agent.lab.step(Tick())
    assert agent.lab.holder == AGENT


# faults 4
def scanning(agent: AgentLab) -> None:
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.SCANNING)


def stopped(agent: AgentLab) -> bool:
    return names.STOP_SCAN in [one.request.subject for one in sent(agent.lab)]


def passes(agent: AgentLab, experiment_s: float) -> None:
    agent.lab.later(experiment_s=experiment_s)
    agent.lab.step(Tick())


def test_scan_ends_with_its_grant_although_an_unused_plan_is_in_force(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.give(plan_of(agent)) is OK
    scanning(agent)
    due_ns = agent.lab.core.deadline_ns()
    assert due_ns is not None
    assert due_ns <= agent.lab.now_ns + 200 * 10**9
    passes(agent, 201.0)
    assert stopped(agent)
    assert agent.lab.holder == AGENT
    agent.lab.answer(sent(agent.lab)[-1])
    agent.lab.scope_is(ScopeState.FREE)
    later_ns = agent.lab.core.deadline_ns()
    assert later_ns is not None
    assert later_ns > due_ns
    # the plan can still be carried out, and nothing beside it
    assert "the grant has run out" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"))
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")) == ""


def test_start_that_is_refused_does_not_lengthen_the_running_scan(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    assert agent.give(agent.plan((ACTION, names.START_SCAN))) is OK
    assert agent.do(ACTION, names.START_SCAN, answers=ControlResponse.NOT_FREE) == ""
    passes(agent, 201.0)
    assert stopped(agent)


def test_start_right_after_a_start_does_not_lengthen_the_scan(agent: AgentLab) -> None:
    agent.lab.scope_is(ScopeState.FREE)
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.FREE)  # a packet from before the start
    assert agent.give(agent.plan((ACTION, names.START_SCAN))) is OK
    assert agent.do(ACTION, names.START_SCAN, answers=ControlResponse.NOT_FREE) == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert stopped(agent)


def test_last_scan_of_a_plan_ends_with_the_plan(agent: AgentLab) -> None:
    agent.begin(agent.plan((SCAN, ScanParameters(HERE)), (ACTION, names.START_SCAN)))
    scanning(agent)
    assert agent.lab.core.state.grants.book.approvals() == Approvals()
    passes(agent, 1700.0)
    assert not stopped(agent)
    passes(agent, 101.0)
    assert stopped(agent)
    assert agent.lab.holder is None


def test_last_scan_of_a_plan_outlasts_a_grant_that_has_run_out(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=60.0), agent.plan((SCAN, ScanParameters(HERE)), (ACTION, names.START_SCAN)))
    scanning(agent)
    passes(agent, 61.0)
    assert not stopped(agent)
    assert agent.lab.holder == AGENT


def test_control_after_a_plan_without_a_scan_ends_with_the_plan(agent: AgentLab) -> None:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    agent.begin(agent.plan((PARAM, bias)))
    assert agent.do(PARAM, bias) == ""
    assert agent.lab.holder == AGENT
    passes(agent, 1801.0)
    assert agent.lab.holder is None


def test_scan_ends_with_its_approval_after_its_agent_released_control(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert not stopped(agent)
    passes(agent, 201.0)
    assert stopped(agent)


def test_revocation_stops_the_scan_of_an_agent_without_control(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert agent.give(Grant(AGENT)) is OK
    assert stopped(agent)


@pytest.mark.parametrize(("lasts_s", "at_s"), [(60.0, 61.0), (900.0, 201.0)])
@pytest.mark.parametrize("releases", [False, True])
def test_replaced_grant_shortens_a_scan_and_never_lengthens_it(
    agent: AgentLab, lasts_s: float, at_s: float, releases: bool
) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    if releases:  # tip T9: no loss of control stops the scan then
        agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert agent.give(agent.grant(lasts_s=lasts_s)) is OK
    passes(agent, at_s - 2.0)
    assert not stopped(agent)
    passes(agent, 2.0)
    assert stopped(agent)


def test_approval_of_an_ended_scan_stops_no_later_scan_of_another(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    agent.lab.scope_is(ScopeState.FREE)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert agent.lab.take_control("series") is OK
    assert agent.do(ACTION, names.START_SCAN, who="series") == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_end_of_a_scan_survives_the_death_of_the_scheduler(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.give(plan_of(agent)) is OK
    scanning(agent)
    agent.lab = killed(agent.lab, agent.settings)
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert stopped(agent)


# faults 4
def test_approval_of_a_pulse_stops_no_scan_begun_at_the_panel(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0, counts=(GrantedCount(names.PULSE, 1),)))
    agent.lab.scope_is(ScopeState.FREE)
    assert agent.do(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.0))) == ""
    assert agent.do(ACTION, names.PULSE) == ""
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_approval_of_a_start_without_effect_stops_no_scan_begun_at_the_panel(agent: AgentLab) -> None:
    agent.lab.scope_is(ScopeState.FREE)
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.FREE)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    agent.lab.later(real_s=agent.settings.control.request_timeout_s + 1.0)
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_scan_of_an_added_action_ends_with_its_approval(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0, counts=(GrantedCount("x-map", 1),)))
    agent.lab.scope_is(ScopeState.FREE)
    assert agent.do(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.0))) == ""
    assert agent.do(ACTION, "x-map", answers=None) == ""
    agent.lab.scope_is(ScopeState.SPEC)
    agent.lab.answer(sent(agent.lab)[-1])
    passes(agent, 201.0)
    assert sent(agent.lab)[-1].request.subject == names.STOP_SPEC


def test_old_state_before_the_scan_of_an_agent_lets_it_end_with_its_approval(agent: AgentLab) -> None:
    agent.lab.scope_is(ScopeState.FREE)
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.FREE)  # a packet from before the start
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert agent.lab.take_control("series") is OK
    assert agent.do(ACTION, names.START_SCAN, who="series", answers=None) == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    agent.lab.answer(sent(agent.lab)[-1], ControlResponse.NOT_FREE)
    passes(agent, 201.0)
    assert stopped(agent)


@pytest.mark.parametrize("comes_first", ["answer", "state"])
@pytest.mark.parametrize("real_s", [0.0, 6.0])
def test_scan_of_another_after_a_restart_outlasts_the_approval_of_an_agent(
    agent: AgentLab, comes_first: str, real_s: float
) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    agent.lab = killed(agent.lab, agent.settings)
    agent.lab.scope_is(ScopeState.FREE)  # the scan has ended while no scheduler ran
    agent.lab.later(real_s=real_s)
    assert agent.lab.take_control("series") is OK
    assert agent.do(ACTION, names.START_SCAN, who="series", answers=None) == ""
    start = sent(agent.lab)[-1]
    if comes_first == "answer":
        agent.lab.answer(start)
    agent.lab.scope_is(ScopeState.SCANNING)
    if comes_first == "state":
        agent.lab.answer(start)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_scan_at_the_panel_some_time_after_a_restart_outlasts_the_approval_of_an_agent(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=200.0))
    scanning(agent)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    agent.lab = killed(agent.lab, agent.settings)
    agent.lab.scope_is(ScopeState.FREE)
    agent.lab.later(real_s=agent.settings.control.request_timeout_s + 1.0)
    agent.lab.scope_is(ScopeState.SCANNING)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_scan_of_a_repeated_start_ends_with_its_approval(agent: AgentLab) -> None:
    agent.lab.scope_is(ScopeState.FREE)
    agent.begin(agent.grant(lasts_s=200.0, counts=(GrantedCount(names.START_SCAN, 1),)))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN, id_=f"{AGENT}/1/again", answers=None) == ""
    for _ in range(4):  # the translator hangs: no answer, then no more wait for a late one
        agent.lab.later(real_s=agent.settings.control.request_timeout_s + 1.0)
        agent.lab.step(Tick())
    agent.lab.scope_is(ScopeState.FREE)
    assert agent.do(ACTION, names.START_SCAN, id_=f"{AGENT}/1/again") == ""
    assert agent.lab.core.state.grants.book.approvals().approvals[0].left == (GrantedCount(names.START_SCAN, 0),)
    agent.lab.scope_is(ScopeState.SCANNING)
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    passes(agent, 201.0)
    assert stopped(agent)


def test_next_plan_does_not_shorten_the_last_scan_of_a_completed_plan(agent: AgentLab) -> None:
    steps = (SCAN, ScanParameters(HERE)), (ACTION, names.START_SCAN)
    agent.begin(agent.plan(*steps))
    scanning(agent)
    assert agent.give(replace(agent.plan(*steps, lasts_s=300.0), plan="next")) is OK
    passes(agent, 301.0)
    assert not stopped(agent)
    passes(agent, 1500.0)
    assert stopped(agent)


def test_replaced_plan_shortens_its_scan_alone(agent: AgentLab) -> None:
    steps = (SCAN, ScanParameters(HERE)), (ACTION, names.START_SCAN), (ACTION, names.START_SCAN)
    agent.begin(agent.plan(*steps))
    scanning(agent)
    assert agent.give(replace(agent.plan(*steps, lasts_s=300.0), plan="next")) is OK
    passes(agent, 301.0)
    assert stopped(agent)


# faults 4
def test_refused_start_of_an_agent_stops_no_scan_of_another(agent: AgentLab) -> None:
    assert agent.lab.take_control("series") is OK
    assert agent.do(ACTION, names.START_SCAN, who="series") == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    agent.lab.says("series", ControlRequest.RELEASE_CTRL)
    agent.begin(agent.grant(lasts_s=200.0))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN, answers=ControlResponse.NOT_FREE) == ""
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    passes(agent, 201.0)
    assert not stopped(agent)


def test_one_packet_revokes_and_takes_control(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    agent.lab.scope_is(ScopeState.SCANNING)
    assert agent.give(Grant(AGENT)) is OK
    assert agent.lab.holder is None
    assert sent(agent.lab)[-1].request.subject == names.STOP_SCAN
    assert agent.lab.take_control(AGENT) is REFUSED


# --- a plan ---------------------------------------------------------------------------------------------------------


def plan_of(agent: AgentLab) -> Grant:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    return agent.plan((PARAM, bias), (SCAN, ScanParameters(HERE, (64, 64))), (ACTION, names.START_SCAN))


def test_plan_is_carried_out_once_in_its_order(agent: AgentLab) -> None:
    bias, place = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V"), ScanParameters(HERE, (64, 64))
    agent.begin(plan_of(agent))
    assert "not request 1" in agent.do(SCAN, place)
    assert "not request 1" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.8", "V"))
    assert agent.do(PARAM, bias) == ""
    assert "not request 2" in agent.do(PARAM, bias)
    assert agent.do(SCAN, place) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    assert "no approval" in agent.do(PARAM, bias)


def test_interrupted_plan_needs_a_new_approval(agent: AgentLab) -> None:
    agent.begin(plan_of(agent))
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")) == ""
    agent.lab.says(AGENT, ControlRequest.RELEASE_CTRL)
    assert agent.lab.take_control(AGENT) is REFUSED


def test_refused_step_may_be_repeated_and_one_of_unknown_outcome_not(agent: AgentLab) -> None:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    agent.begin(plan_of(agent))
    assert agent.do(PARAM, bias, answers=ControlResponse.NOT_FREE) == ""
    assert agent.do(PARAM, bias, "agent:claude/1/a", ControlResponse.NO_RESPONSE) == ""
    for wanted in ((PARAM, bias), (SCAN, ScanParameters(HERE, (64, 64)))):
        assert "request 1 of abc has no known success" in agent.do(*wanted)
    assert agent.do(PARAM, bias, "agent:claude/1/a") == ""
    assert agent.do(SCAN, ScanParameters(HERE, (64, 64))) == ""


@pytest.mark.parametrize("stop", [names.STOP_SCAN, names.STOP_SPEC])
def test_stop_is_no_step_of_a_plan(agent: AgentLab, stop: str) -> None:
    agent.begin(plan_of(agent))
    assert agent.do(ACTION, stop) == ""
    assert "not request 1" in agent.do(SCAN, ScanParameters(HERE, (64, 64)))
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")) == ""
    assert agent.do(ACTION, stop, answers=ControlResponse.NO_RESPONSE) == ""
    assert "not request 2" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V"))
    assert agent.do(SCAN, ScanParameters(HERE, (64, 64))) == ""


def test_stop_counts_where_it_is_a_step_of_the_plan(agent: AgentLab) -> None:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    agent.begin(agent.plan((PARAM, bias), (ACTION, names.STOP_SCAN), (SCAN, ScanParameters(HERE))))
    assert agent.do(PARAM, bias) == ""
    assert "not request 2" in agent.do(SCAN, ScanParameters(HERE))
    assert agent.do(ACTION, names.STOP_SCAN) == ""
    assert agent.do(SCAN, ScanParameters(HERE)) == ""


def test_stop_is_sent_after_the_end_of_the_approval(agent: AgentLab) -> None:
    agent.begin(agent.grant(lasts_s=60.0))
    agent.lab.later(experiment_s=61.0)
    assert agent.do(ACTION, names.STOP_SCAN) == ""
    assert "no approval" in agent.do(ACTION, names.START_SCAN)


def test_reads_and_repeated_requests_are_no_steps_of_a_plan(agent: AgentLab) -> None:
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")
    agent.begin(plan_of(agent))
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE), answers=None) == ""
    agent.lab.answer_reads(tip_bias_voltage="0")
    assert "not request 1" in agent.do(SCAN, ScanParameters(HERE, (64, 64)))
    assert agent.do(PARAM, bias, "agent:claude/1/a", ControlResponse.NO_RESPONSE) == ""
    assert agent.do(PARAM, bias, "agent:claude/1/a", ControlResponse.NO_RESPONSE) == ""
    assert agent.do(PARAM, bias, "agent:claude/1/a") == ""
    assert "not request 2" in agent.do(PARAM, bias)


def test_grant_waits_while_a_plan_is_carried_out(agent: AgentLab) -> None:
    low, high = (Parameter(names.TIP_BIAS_VOLTAGE, volts, "V") for volts in ("0.1", "0.4"))
    place = (SCAN, ScanParameters(HERE, (64, 64)))
    agent.begin(agent.grant(), agent.plan((PARAM, low), place, (ACTION, names.START_SCAN)))
    assert agent.do(PARAM, high) == ""
    assert agent.do(PARAM, low) == ""
    assert "the grant waits for the end of the plan" in agent.do(PARAM, high)
    assert agent.do(*place) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    assert agent.do(PARAM, high) == ""


def test_plan_approved_again_does_not_go_back_for_a_late_refusal(agent: AgentLab) -> None:
    bias, place = Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V"), ScanParameters(HERE, (64, 64))
    agent.begin(plan_of(agent))
    assert agent.do(PARAM, bias, answers=None) == ""
    sent_before = agent.lab.forwarded[-1]
    agent.give(plan_of(agent))
    agent.lab.answer(sent_before, ControlResponse.NOT_FREE)
    assert agent.do(PARAM, bias) == ""
    assert agent.do(SCAN, place) == ""


def test_repeated_id_with_another_content_is_refused(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V")
    assert agent.do(PARAM, bias, "agent:claude/1/a", ControlResponse.NO_RESPONSE) == ""
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V"), "agent:claude/1/a") != ""


def test_scan_of_a_plan_does_not_start_where_a_person_has_moved_it(agent: AgentLab) -> None:
    agent.begin(plan_of(agent))
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.9", "V")) == ""
    assert agent.do(SCAN, ScanParameters(HERE, (64, 64))) == ""
    agent.place = FAR
    assert "outside the region" in agent.do(ACTION, names.START_SCAN)


# --- a grant --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "subject"),
    [
        (PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.6", "V")),
        (PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "nan", "V")),
        (PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.6")),
        (PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "600", "mV")),
        (PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "inf", "V")),
        (PARAM, Parameter(names.SCAN_SPEED, "1e-6", "m/s")),
        (PARAM, Parameter(names.SCAN_SIZE_X, "1e-6", "m")),
        (PARAM, Parameter(names.FEEDBACK_ON, "off")),
        (int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(on=False)),
        (int(ControlRequest.SET_ZCTRL_PARAMS), Feedback(setpoint=1e-9)),
        (SCAN, ScanParameters(FAR)),
        (SCAN, ScanParameters(RegionChange(left_m=0.0))),
        (ACTION, names.PULSE),
        (ACTION, "x-crash"),
        (ACTION, names.START_SPEC),
        (ACTION, names.START_SCAN),  # the place was set by another component
    ],
)
def test_request_outside_of_the_grant_is_refused(agent: AgentLab, kind: int, subject: Any) -> None:
    agent.begin(agent.grant())
    agent.place = HERE
    assert agent.do(kind, subject) != ""


@pytest.mark.parametrize(
    ("kind", "subject", "part"),
    [
        (PARAM, Parameter(names.SCAN_TOP_LEFT_X, "0", "m"), names.SCAN_TOP_LEFT_X),
        (PARAM, Parameter(names.SCAN_ANGLE, "0", "deg"), names.SCAN_ANGLE),
        (PARAM, Parameter(names.PROBE_POS_X, "0", "m"), names.PROBE_POS_X),
        (SCAN, ScanParameters(RegionChange(left_m=0.0)), names.SCAN_TOP_LEFT_X),
    ],
)
def test_part_of_a_place_is_refused_with_the_cure(agent: AgentLab, kind: int, subject: Any, part: str) -> None:
    agent.begin(agent.grant())
    assert agent.do(kind, subject).startswith(f"{part} is a part of a place, and a grant allows whole places")


def test_spectrum_at_the_edge_of_a_grant_is_allowed(agent: AgentLab) -> None:
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SPEC, 1),)))
    assert agent.do(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.999 * UM))) == ""
    curve = {"x_spec_kind": "IV", "x_spec_from": "-0.5", "x_spec_to": "0.5"}
    agent.in_force = {"probe_pos_y": str(0.999 * UM), **curve}
    assert agent.do(ACTION, names.START_SPEC) == ""


def test_curve_beyond_the_range_of_a_grant_is_refused(agent: AgentLab) -> None:
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SPEC, 1),)))
    assert agent.do(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.0))) == ""
    agent.in_force = {"x_spec_kind": "IV", "x_spec_from": "-0.5", "x_spec_to": "0.6"}
    assert "x-spec-to = 600 mV is above the highest allowed, 500 mV" in agent.do(ACTION, names.START_SPEC)


def test_value_with_a_unit_is_outside_a_range_whose_unit_is_unknown(agent: AgentLab) -> None:
    volts, amperes = GrantedRange(names.PULSE_VOLTAGE, -2.0, 2.0), GrantedRange(names.ZCTRL_SETPOINT, 0.0, 1e-10)
    agent.begin(agent.grant(ranges=(volts, amperes)))
    assert "kV" in agent.do(PARAM, Parameter(names.PULSE_VOLTAGE, "2", "kV"))
    assert "kA" in agent.do(PARAM, Parameter(names.ZCTRL_SETPOINT, "5e-11", "kA"))
    assert agent.do(PARAM, Parameter(names.PULSE_VOLTAGE, "2")) == ""
    assert agent.do(PARAM, Parameter(names.ZCTRL_SETPOINT, "5e-11")) == ""


def test_grant_counts_its_scans(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    for _ in range(2):
        assert agent.do(SCAN, ScanParameters(HERE)) == ""
        assert agent.do(ACTION, names.START_SCAN) == ""
    assert "used up" in agent.do(ACTION, names.START_SCAN)


def test_refused_scan_does_not_count(agent: AgentLab) -> None:
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SCAN, 1),)))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN, answers=ControlResponse.NOT_FREE) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    assert "used up" in agent.do(ACTION, names.START_SCAN)


def start(request_id: str, agent: AgentLab, subject: Any = names.START_SCAN, kind: int = ACTION) -> Request:
    return Request(kind, subject, agent.lab.codec.encode(subject), f"{AGENT}/1/{request_id}")


def test_use_that_certainly_failed_counts_when_it_is_sent_again_under_its_id(agent: AgentLab) -> None:
    # faults, mutant of grants.py: the id stayed spent, so that the second sending was not counted
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SCAN, 1),)))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    checker, now_ns, first = agent.lab.core.state.grants, agent.lab.now_ns, start("a", agent)
    checker = checker.sending(AGENT, first, now_ns, None).not_done(AGENT, first)
    checker = checker.sending(AGENT, first, now_ns, None)
    assert checker.book.approvals().approvals[0].left == (GrantedCount(names.START_SCAN, 0),)


def test_spent_id_stands_for_its_content_alone(agent: AgentLab) -> None:
    # faults, mutant of grants.py; the scheduler's memory of answers may have forgotten the id
    agent.begin(agent.grant())
    low, high = (Parameter(names.TIP_BIAS_VOLTAGE, value, "V") for value in ("0.1", "0.2"))
    checker, now_ns = agent.lab.core.state.grants, agent.lab.now_ns
    checker = checker.sending(AGENT, start("a", agent, low, PARAM), now_ns, None)
    assert checker.refused(AGENT, start("a", agent, low, PARAM), now_ns, None, LimitState()) is None
    refusal = checker.refused(AGENT, start("a", agent, high, PARAM), now_ns, None, LimitState())
    assert refusal is not None
    assert refusal.reason == "this id is of another request"


def test_agent_sets_its_place_again_after_it_gave_control_back(agent: AgentLab) -> None:
    # faults, mutant of grants.py: others may have moved the frame meanwhile
    agent.begin(agent.grant())
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.lab.says(AGENT, int(ControlRequest.RELEASE_CTRL)) is OK
    assert agent.lab.take_control(AGENT) is OK
    assert "has not set the place" in agent.do(ACTION, names.START_SCAN)


def test_counts_survive_a_kill_before_the_answer(agent: AgentLab) -> None:
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SCAN, 1),)))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN, answers=None) == ""
    again = killed(agent.lab, agent.settings)
    assert again.core.state.grants.book.approvals().approvals[0].left == (GrantedCount(names.START_SCAN, 0),)


def test_approvals_are_published_at_each_change(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    assert agent.do(ACTION, names.START_SCAN) == ""
    told = [agent.lab.codec.decode(one.payload) for one in published(agent.lab.effects) if one.envelope == "Approvals"]
    assert [one.approvals[0].left[0].count for one in told] == [2, 1]
    agent.give(Grant(AGENT))
    newest = [one for one in published(agent.lab.effects) if one.envelope == "Approvals"][-1]
    assert agent.lab.codec.decode(newest.payload) == Approvals()


# --- [limits.roles] -------------------------------------------------------------------------------------------------


def test_limits_of_the_role_hold_also_for_an_approved_plan() -> None:
    agent = AgentLab(replace(LIMITS, roles={"agent": ROLE}))
    bias = Parameter(names.TIP_BIAS_VOLTAGE, "2", "V")
    agent.begin(agent.plan((PARAM, bias)))
    assert "above the highest" in agent.do(PARAM, bias)


def test_limits_of_the_role_bound_actions_parameters_and_region() -> None:
    agent = AgentLab(replace(LIMITS, roles={"agent": ROLE}))
    speed = Parameter(names.SCAN_SPEED, "1e-6", "m/s")
    agent.begin(agent.plan((PARAM, speed)))
    assert "not among the parameters" in agent.do(PARAM, speed)
    agent.give(agent.plan((ACTION, names.PULSE)))
    assert "not among the actions" in agent.do(ACTION, names.PULSE)
    agent.give(agent.plan((SCAN, ScanParameters(FAR))))
    assert "outside the region" in agent.do(SCAN, ScanParameters(FAR))


def test_limits_of_the_role_count_over_approvals() -> None:
    agent = AgentLab(replace(LIMITS, roles={"agent": ROLE}))
    agent.begin(agent.grant(counts=(GrantedCount(names.START_SCAN, 3),)))
    assert agent.do(SCAN, ScanParameters(HERE)) == ""
    for _ in range(3):
        assert agent.do(ACTION, names.START_SCAN) == ""
    agent.give(agent.grant(counts=(GrantedCount(names.START_SCAN, 3),)))
    assert agent.do(ACTION, names.START_SCAN) == ""
    assert "within an hour" in agent.do(ACTION, names.START_SCAN)
    agent.lab.later(experiment_s=3601.0)
    agent.give(agent.grant())
    assert agent.do(ACTION, names.START_SCAN) == ""


def test_limits_of_a_role_hold_for_a_component_that_is_no_agent() -> None:
    agent = AgentLab(replace(LIMITS, roles={"series": ROLE}))
    assert agent.lab.take_control("series") is OK
    assert "above the highest" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "2", "V"), who="series")
    assert agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.5", "V"), who="series") == ""


def test_actions_without_ids_count_within_the_hour() -> None:
    # only agents must send ids
    agent = AgentLab(replace(LIMITS, roles={"series": replace(ROLE, per_hour={names.START_SCAN: 2})}))
    agent.place = HERE
    assert agent.lab.take_control("series") is OK
    asked = [agent.do(ACTION, names.START_SCAN, id_=NO_ID, who="series") for _ in range(3)]
    assert asked[:2] == ["", ""]
    assert "2 are allowed" in asked[2]


PULSES = RoleLimits(ExperimentLimits({names.PULSE_VOLTAGE: Limit(-2.0, 2.0, unit="V", source="experiment.toml:9")}))


def test_pulse_with_a_voltage_in_force_beyond_the_role_is_refused() -> None:
    agent = AgentLab(replace(LIMITS, roles={"series": PULSES}))
    assert agent.lab.take_control("series") is OK
    agent.in_force = {"x_pulse_voltage": "5"}
    assert "x-pulse-voltage = 5 V is above the highest allowed, 2 V" in agent.do(ACTION, names.PULSE, who="series")
    agent.in_force = {"x_pulse_voltage": "2"}
    assert agent.do(ACTION, names.PULSE, who="series") == ""


def test_pulse_with_a_voltage_in_force_beyond_the_grant_is_refused(agent: AgentLab) -> None:
    ranges = (GrantedRange(names.PULSE_VOLTAGE, -2.0, 2.0),)
    agent.begin(agent.grant(ranges=ranges, counts=(GrantedCount(names.PULSE, 5),)))
    assert agent.do(int(ControlRequest.SET_PROBE_POS), ProbePosition((0.0, 0.0))) == ""
    agent.in_force = {"x_pulse_voltage": "-5"}
    assert "x-pulse-voltage = -5 is below the lowest allowed" in agent.do(ACTION, names.PULSE)
    agent.in_force = {"x_pulse_voltage": "-2"}
    assert agent.do(ACTION, names.PULSE) == ""


# --- parameters of other instruments --------------------------------------------------------------------------------


class MagnetLab(AgentLab):
    """An agent beside an instrument, which reports the field of a magnet."""

    def __init__(self, limits: ExperimentLimits = LIMITS) -> None:
        super().__init__(limits)
        self.settings = replace(self.settings, instruments=InstrumentSettings(("magnet",)))
        self.lab = Lab(self.settings)
        self.lab.translator()
        self.token = 0
        for _ in range(2):  # only the second report repeats a token
            self.report()

    def report(self, *outcomes: OrderOutcome) -> tuple[InstrumentOrder, ...]:
        reading = InstrumentReading(FIELD, 0.0, "T", 0.1, 0.0)
        report = InstrumentReadings(self.lab.now_ns, "magnet", (reading,), outcomes, self.token)
        relayed = RelayedMessage("InstrumentReadings", self.lab.codec.encode(report))
        answer = replies(self.lab.ask("magnet", RELAY_REQUEST, relayed))[-1].response
        orders = self.lab.codec.decode(answer.payload)
        self.token = orders.token
        return tuple(orders.orders)

    def set_field(self, value: str, unit: str = "T", who: str = AGENT) -> str:
        """Set the field: the reason of the refusal; "" if the instrument has carried it out."""
        self.ids += 1
        self.lab.ask(who, PARAM, Parameter(FIELD, value, unit), f"{who}/1/{self.ids}")
        before = len(self.lab.effects)
        if not (orders := self.report()):
            return replies(self.lab.effects[before:])[0].response.reason
        assert self.report(OrderOutcome(orders[0].number, OK)) == ()
        return ""


FIELD = "magnet.field"
OF_FIELD = ExperimentLimits(parameters={FIELD: Limit(-1.0, 1.0, unit="T")})


def test_agent_sets_a_parameter_of_an_instrument_only_in_an_approved_plan() -> None:
    agent = MagnetLab()
    agent.begin(agent.grant())
    assert "the grant does not include magnet.field" in agent.set_field("0.5")
    field, bias = Parameter(FIELD, "0.5", "T"), Parameter(names.TIP_BIAS_VOLTAGE, "2", "V")
    agent.give(agent.plan((PARAM, field), (PARAM, bias)))
    assert agent.set_field("0.5") == ""
    assert "not request 2" in agent.set_field("0.5")
    assert agent.do(PARAM, bias) == ""
    assert "the grant does not include" in agent.set_field("0.5")


def test_range_of_a_grant_has_no_unit_and_allows_no_value_of_an_instrument_with_one() -> None:
    agent = MagnetLab()
    agent.begin(agent.grant(ranges=(GrantedRange(FIELD, -0.5, 0.5),)))
    assert "can't be converted" in agent.set_field("0.4", "kT")


def test_limits_of_a_role_hold_for_a_parameter_of_an_instrument() -> None:
    agent = MagnetLab(replace(LIMITS, roles={"series": RoleLimits(OF_FIELD, parameters_only=True), "other": ROLE}))
    for who in ("series", "other"):
        assert agent.lab.take_control(who) is OK
        refusals = [agent.set_field(value, who=who) for value in ("0.5", "9")]
        agent.lab.says(who, ControlRequest.RELEASE_CTRL)
        if who == "series":
            assert refusals[0] == ""
            assert "above the highest allowed, 1 T" in refusals[1]
        else:
            assert all("not among the parameters of other" in why for why in refusals)


# --- lease and stop -------------------------------------------------------------------------------------------------


def test_agent_without_a_lease_of_its_own_loses_control_after_a_minute(agent: AgentLab) -> None:
    agent.begin(agent.grant())
    agent.lab.later(real_s=61.0)
    agent.lab.step(Tick())
    assert agent.lab.holder is None
    assert "not in control" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"))


def test_command_that_arrives_with_the_end_of_the_lease_is_refused(agent: AgentLab) -> None:
    # a frozen scheduler finds both in one step
    agent.begin(agent.grant())
    agent.lab.later(real_s=61.0)
    assert "lease of agent:claude has ended" in agent.do(PARAM, Parameter(names.TIP_BIAS_VOLTAGE, "0.1", "V"))


def test_stop_needs_no_approval_and_only_a_person_clears_it(agent: AgentLab) -> None:
    agent.lab.take_control("series")
    agent.lab.scope_is(ScopeState.SCANNING)
    assert agent.lab.flag(AGENT, STOP) is OK
    assert agent.lab.holder is None
    assert sent(agent.lab)[-1].request.subject == names.STOP_SCAN
    assert agent.lab.take_control("series") is ControlResponse.WRONG_EXP_PROBLEM
    for who in (AGENT, "series", "corrector"):
        assert agent.lab.clear(who, STOP) is REFUSED
    assert agent.lab.clear(ADA, STOP) is OK
    assert agent.lab.take_control("series") is OK


def test_stop_takes_control_from_a_solver_too(agent: AgentLab) -> None:
    agent.lab.flag("classifier", Problem.TIP_SHAPE_CHANGED)
    assert agent.lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED) is OK
    assert agent.lab.flag(AGENT, STOP) is OK
    assert agent.lab.holder is None
    assert agent.lab.take_control("corrector", Problem.TIP_SHAPE_CHANGED) is ControlResponse.WRONG_EXP_PROBLEM


def test_stop_stops_the_scan_though_problems_do_not(agent: AgentLab) -> None:
    control = replace(agent.settings.control, stop_scan_on_problem=False, stop_scan_on_manual=False)
    agent.settings = replace(agent.settings, control=control, watchdog=control.watchdog())
    agent.lab = Lab(agent.settings)
    agent.lab.translator()
    agent.lab.scope_is(ScopeState.SCANNING)
    agent.lab.flag(AGENT, STOP)
    assert sent(agent.lab)[-1].request.subject == names.STOP_SCAN


def test_person_in_manual_is_not_stopped_by_an_agent(agent: AgentLab) -> None:
    agent.lab.mode(ADA, ControlMode.MANUAL)
    agent.lab.scope_is(ScopeState.SCANNING)
    before = len(sent(agent.lab))
    assert agent.lab.flag(AGENT, STOP) is OK
    assert len(sent(agent.lab)) == before


# --- the message ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong",
    [
        {"region_m": (0.0, 0.0, float("nan"), 1e-6)},
        {"region_m": (0.0, 0.0, 1e-6)},
        {"region_m": (0.0, 0.0, -1e-6, 1e-6)},
        {"lasts_s": float("inf")},
        {"lasts_s": -1.0},
        {"plan": "abc"},
        {"steps": (GrantedStep(1),)},
        {"ranges": (GrantedRange("a", 1.0, 0.0),)},
        {"ranges": (GrantedRange("a", float("nan"), 1.0),)},
        {"counts": (GrantedCount("a", -1),)},
        {"counts": (GrantedCount("a", 10**6),)},
    ],
)
def test_malformed_grant_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidValue):
        Grant(**{"agent": AGENT, **wrong})


def test_grant_survives_the_wire() -> None:
    from afspm import wire

    grant = Grant(
        AGENT, "", (), (0.0, 1e-9, 1e-6, 2e-6), (GrantedRange("a", -1.0, 1.0),), (GrantedCount("start-scan", 3),),
        600.0, "night", "abc", 5 * 10**9, (1e-9, 2e-9), 1e-8,
    )  # fmt: skip
    asked = wire.decode_request(wire.encode_request(Request(GRANT_REQUEST, grant, id="1")))
    assert asked.subject == grant
