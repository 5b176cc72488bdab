"""Checks of the loss of control to a person or a problem, and of killed processes meanwhile."""

from __future__ import annotations

from collections.abc import Callable

from afspm.model import ControlMode, Region, ScopeState
from afspm.testing.clients.bench import ClientBench
from afspm.testing.clients.checks.measure import SCAN_S, require_scans, scan_step
from afspm.testing.clients.client_suite import client_check
from afspm.testing.clients.experiment import CLIENT, SCHEDULER, TRANSLATOR, JudgedExperiment
from afspm.testing.clients.program import Answer, ClientProgram
from afspm.testing.conformance import expect

KNOWN_S = 5.0
_PROBLEM = 1  # EP_TIP_SHAPE_CHANGED
_LONG = (256, 64)
"""Rows and columns of a scan that takes some seconds."""


def _require_state(experiment: JudgedExperiment, program: ClientProgram, **right: object) -> None:
    state: Answer = Answer()

    def is_known() -> bool:
        nonlocal state
        state = program.succeed("state")
        return all(state.get(name) == value for name, value in right.items())

    until_s = experiment.clock.monotonic_s() + KNOWN_S
    while not is_known() and experiment.clock.monotonic_s() < until_s:
        experiment.pump(lambda: False, 0.05)
    words = ", ".join(f"{name} = {value!r}" for name, value in right.items())
    expect(is_known(), f"the client to know that {words}", str(state))


@client_check(
    "control/manual",
    "In MANUAL the client knows that it is not in control, is refused, and gets control again afterwards.",
    "Follow `ControlState`: `client_in_control_id` and `control_mode`.",
)
def manual(bench: ClientBench) -> None:
    experiment = bench.experiment
    with bench.client(experiment) as client:
        program = client.program
        program.succeed("request_control", problem=0, timeout_s=10.0)
        _require_state(experiment, program, in_control=True, holder=CLIENT, mode="CM_AUTOMATED", problems=[])
        try:
            program.succeed("mode", mode="CM_MANUAL")
            _require_state(experiment, program, in_control=False, holder=None, mode="CM_MANUAL")
            refused = program.do("action", name="start-scan")
            right = ("REP_WRONG_CONTROL_MODE", "REP_NOT_IN_CONTROL")
            expect(refused.get("response") in right, " or ".join(right), str(refused))
            again = program.begin("request_control", problem=0, timeout_s=20.0)
            experiment.pump(lambda: program.is_answered(again), 1.0)
            expect(not program.is_answered(again), "control to be waited for in MANUAL", "an answer")
        finally:
            experiment.scope.set_mode(ControlMode.AUTOMATED)
        answer = program.answer(again)
        expect(answer.ok, "control as soon as the mode is AUTOMATED", str(answer))
        _require_state(experiment, program, in_control=True, mode="CM_AUTOMATED")
        program.succeed("release_control")
        _require_state(experiment, program, in_control=False, holder=None)


@client_check(
    "control/problem",
    "The client flags a problem, gets control to solve it while others do not, and clears it.",
    "The object of these requests is one byte: the problem's number, as in `ExperimentProblem`.",
)
def problem(bench: ClientBench) -> None:
    experiment = bench.experiment
    scope = experiment.scope
    with bench.client(experiment) as client:
        program = client.program
        program.succeed("problem", number=_PROBLEM, set=True)
        try:
            flagged = experiment.pump(lambda: _PROBLEM in scope.control_state.problems, KNOWN_S)
            expect(flagged, f"the problem {_PROBLEM} to be flagged", str(scope.control_state))
            refused = program.do("request_control", problem=0, timeout_s=3.0)
            expect(refused.get("response") == "REP_WRONG_EXP_PROBLEM", "REP_WRONG_EXP_PROBLEM", str(refused))
            program.succeed("request_control", problem=_PROBLEM, timeout_s=10.0)
            _require_state(experiment, program, in_control=True, problems=[_PROBLEM])
        finally:
            program.do("problem", number=_PROBLEM, set=False)
        cleared = experiment.pump(lambda: not scope.control_state.problems, KNOWN_S)
        expect(cleared, "no problem any more", str(scope.control_state))
        _require_state(experiment, program, problems=[])
        program.do("release_control")


def _interrupted(bench: ClientBench, disturb: Callable[[JudgedExperiment, ClientProgram], None]) -> Answer:
    experiment = bench.experiment
    asked = scan_step(_LONG)
    with bench.client(experiment) as client:
        step = client.program.begin("scan", **asked)
        begun = experiment.pump(lambda: experiment.scope.state is ScopeState.SCANNING, 20.0)
        expect(begun, "the scan to begin", f"the state {experiment.scope.state.name}")
        disturb(experiment, client.program)
        answer = client.program.answer(step, SCAN_S)
        require_scans(experiment, answer, asked)
        free = experiment.pump(lambda: experiment.scope.control_state.holder is None, 5.0)
        expect(free, "control given back after the scan", "a client that keeps it")
    return answer


@client_check(
    "control/repair",
    "A scan that loses control to a tip repair is taken again when that is done.",
    "Wait until no problem is set and the microscope is free, ask for control, set the frame again, start again.",
)
def repair(bench: ClientBench) -> None:
    def mend(experiment: JudgedExperiment, program: ClientProgram) -> None:
        scope = experiment.scope
        scope.flag(_PROBLEM)
        try:
            with scope.control(solving=_PROBLEM, timeout_s=20.0):
                _require_state(experiment, program, in_control=False, problems=[_PROBLEM])
                elsewhere = Region(center_m=(2e-6, 2e-6), size_m=(0.4e-6, 0.4e-6))
                scope.scan(elsewhere, shape=(8, 8), timeout_s=60.0)
                refused = program.do("action", name="start-scan")
                expect(refused.get("response") == "REP_NOT_IN_CONTROL", "REP_NOT_IN_CONTROL", str(refused))
        finally:
            scope.clear(_PROBLEM)

    answer = _interrupted(bench, mend)
    expect(answer.get("interruptions", 0) >= 1, "at least one interruption", str(answer.get("interruptions")))


@client_check(
    "faults/scheduler",
    "A scheduler that is killed and started again during a scan costs the scan nothing but time.",
    "Take a lost connection for a restart, not for a refusal; ask for control again.",
)
def scheduler_killed(bench: ClientBench) -> None:
    _interrupted(bench, lambda experiment, program: experiment.restart(SCHEDULER))


@client_check(
    "faults/translator",
    "The same with the translator.",
    "`REP_FAILURE` or `REP_NO_RESPONSE` with the detail 1 or 2 while it is away: wait for `SS_FREE`, and start again.",
)
def translator_killed(bench: ClientBench) -> None:
    _interrupted(bench, lambda experiment, program: experiment.restart(TRANSLATOR))
