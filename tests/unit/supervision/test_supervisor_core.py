"""Decisions of the supervisor about all processes of a run, without a process."""

from __future__ import annotations

import signal
from typing import NamedTuple

import pytest

from afspm.basics.exit_codes import ExitCode
from afspm.model import LogLine, Role
from afspm.supervisor.supervision.child import ChildPolicy, RestartPolicy
from afspm.supervisor.supervision.liveness import LivenessPolicy
from afspm.supervisor.supervision.run_end import ASK_AGAIN_S, IDLE_AFTER_S, KILL_AFTER_S, OWN_PACE_S, TIP_S, EndReason
from afspm.supervisor.supervision.supervised_child import CLOSES_WITHIN_S, ChildSpec
from afspm.supervisor.supervision.supervisor_core import SCHEDULER_ANSWERS_WITHIN_S, SupervisorCore
from afspm.supervisor.supervision.supervisor_events import (
    ActivitySeen,
    AskUse,
    Beaten,
    EndExperiment,
    EndRefused,
    EndSignal,
    Exited,
    ProcessAction,
    ProcessCommand,
    ProcessStarted,
    ReleaseComponents,
    RestartOrdered,
    RunBegan,
    SchedulerAnswered,
    StartFailed,
    SupervisorEffect,
    SupervisorEvent,
    TimePassed,
    UseReported,
    WriteLog,
    describe_exit,
)

START, KILL, CLOSE, ABANDON = ProcessAction
POLICY = ChildPolicy(LivenessPolicy(beat_period_s=1.0, missed_beats=3), RestartPolicy(budget=1))
SPECS = [ChildSpec("scope", Role.TRANSLATOR), ChildSpec("scheduler", Role.SCHEDULER), ChildSpec("series")]


class Beat(NamedTuple):
    closing: bool = False
    step_age_s: float | None = None
    longest_step_s: float | None = None


class Run:
    """A run whose processes start at once; its commands are kept."""

    def __init__(self, *specs: ChildSpec, awaits_scheduler: bool = False, ends_idle: bool = False) -> None:
        self.core = SupervisorCore(specs or SPECS, POLICY, awaits_scheduler=awaits_scheduler, ends_idle=ends_idle)
        self.pids: dict[str, int] = {}
        self.now_s = 100.0
        self.commands: list[tuple[ProcessAction, str]] = []
        self.lines: list[WriteLog] = []
        self.others: list[SupervisorEffect] = []
        self.step(RunBegan())

    def step(self, event: SupervisorEvent, after_s: float = 0.0) -> list[tuple[ProcessAction, str]]:
        """Return the commands that follow an event."""
        self.now_s += after_s
        before = len(self.commands)
        self._take(event)
        return self.commands[before:]

    def _take(self, event: SupervisorEvent) -> None:
        for effect in self.core.step(event, self.now_s):
            match effect:
                case ProcessCommand(action, name):
                    self.commands.append((action, name))
                    if action is START and self.core.may_start(name):
                        self.pids[name] = self.pids.get(name, len(self.pids) * 100) + 1
                        self._take(ProcessStarted(name, self.pids[name]))
                case WriteLog():
                    self.lines.append(effect)
                case _:
                    self.others.append(effect)

    def exits(self, name: str, code: int, error: str = "") -> list[tuple[ProcessAction, str]]:
        return self.step(Exited(name, self.pids[name], code, error))

    def beat(self, *names: str, closing: bool = False) -> None:
        for name in names or [spec.name for spec in SPECS]:
            self.step(Beaten(name, Beat(closing)))


def test_all_are_started_at_the_beginning() -> None:
    assert Run().commands == [(START, "scope"), (START, "scheduler"), (START, "series")]


def test_crashing_process_is_restarted() -> None:
    run = Run()
    assert run.exits("series", 1, "it breaks") == [(START, "series")]
    assert run.core.children["series"].last_exit == "crashed: it breaks"


@pytest.mark.parametrize("code", [ExitCode.CRASHED, ExitCode.OWN_FAULT])
def test_first_crash_of_user_code_is_followed_by_a_remedy_once(code: ExitCode) -> None:
    run = Run(*SPECS[:2], ChildSpec("series", has_user_code=True))
    run.exits("series", code)
    assert run.lines[-1].text.startswith("correct the file")
    assert "`afspm restart series`" in run.lines[-1].text
    run.exits("series", code)
    run.step(RestartOrdered("series"))
    run.exits("series", code)
    assert sum("correct the file" in line.text for line in run.lines) == 1


@pytest.mark.parametrize(
    ("has_user_code", "code"), [(False, ExitCode.CRASHED), (True, -9)]
)  # SIGKILL, which Windows lacks
def test_kill_or_a_crash_of_afspms_code_is_followed_by_no_remedy(has_user_code: bool, code: int) -> None:
    run = Run(*SPECS[:2], ChildSpec("series", has_user_code=has_user_code))
    run.exits("series", code)
    assert any("restarting" in line.text for line in run.lines)
    assert not any("correct the file" in line.text for line in run.lines)


def test_exit_of_an_earlier_process_is_ignored() -> None:
    run = Run()
    run.exits("series", 1)
    assert run.step(Exited("series", run.pids["series"] - 1, 1)) == []


def test_run_is_lost_without_a_translator_and_goes_on_without_a_component() -> None:
    run = Run()
    run.exits("series", ExitCode.CONFIG, "no such channel")
    assert run.core.ending is None
    assert run.lines[-1].level == "CRITICAL"
    assert run.exits("scope", ExitCode.CONFIG) == []
    assert run.core.ending is not None
    assert run.core.ending.why is EndReason.LOST


def test_translator_that_ends_unannounced_has_crashed() -> None:
    run = Run()
    run.beat()
    assert run.exits("scope", ExitCode.DONE) == [(START, "scope")]
    run.beat("scope", closing=True)
    run.exits("scope", ExitCode.DONE)
    assert run.core.ending is not None
    assert run.core.ending.why is EndReason.EXPERIMENT_ENDED


def test_one_signal_asks_all_to_end_and_a_second_kills() -> None:
    run = Run()
    run.beat()
    run.step(EndSignal(signal.SIGINT))
    assert run.step(TimePassed()) == [(CLOSE, "scope"), (CLOSE, "scheduler"), (CLOSE, "series")]
    run.step(EndSignal(signal.SIGINT))
    assert run.step(TimePassed()) == [(KILL, "scope"), (KILL, "scheduler"), (KILL, "series")]
    for name in run.pids:
        assert not run.core.is_over
        run.exits(name, -9)
    assert run.core.is_over


def test_process_that_can_not_be_killed_is_abandoned() -> None:
    run = Run(ChildSpec("series"))
    run.step(EndSignal(signal.SIGTERM))
    for _ in range(2):
        run.step(TimePassed(), KILL_AFTER_S)
    assert run.step(TimePassed(), 60.0) == [(ABANDON, "series")]
    assert run.core.is_over


def test_component_that_died_unfinished_at_the_end_is_restarted_once() -> None:
    run = Run()
    run.beat()
    assert run.exits("scheduler", ExitCode.ENDED) == [(CLOSE, "scope")]
    assert run.exits("series", 1) == [(START, "series")]
    assert run.exits("series", 1) == []


def test_the_scheduler_stays_until_all_others_have_left() -> None:
    run = Run()
    run.beat()
    run.exits("scope", ExitCode.ENDED)
    assert (CLOSE, "scheduler") not in run.step(TimePassed(), 0.1)
    run.exits("series", ExitCode.ENDED)
    assert run.step(TimePassed(), 0.1) == [(CLOSE, "scheduler")]


def test_a_component_that_works_on_a_step_is_waited_for_at_the_end() -> None:
    run = Run()
    run.beat()
    run.step(Beaten("series", Beat(step_age_s=1.0, longest_step_s=100.0)))
    run.exits("scope", ExitCode.ENDED)
    assert run.step(TimePassed(), OWN_PACE_S) == []
    assert run.lines[-1].text == "waiting for series to finish; Ctrl-C ends it now"


def test_component_stopped_in_a_step_after_the_end_is_logged_and_reported() -> None:
    run = Run()
    run.beat()
    run.step(Beaten("series", Beat(step_age_s=1.0, longest_step_s=100.0)))
    run.exits("scope", ExitCode.ENDED)
    run.exits("scheduler", ExitCode.ENDED)
    while (CLOSE, "series") not in run.commands:
        run.step(TimePassed(), 0.25)
        run.step(Beaten("series", Beat(step_age_s=run.now_s - 100.0, longest_step_s=100.0)))
    run.exits("series", ExitCode.ORPHAN)
    how = "stopped 1 min 00 s after the end of the experiment, before it had finished"
    assert (run.lines[-1].name, run.lines[-1].level) == ("series", "WARNING")
    assert run.lines[-1].text.startswith(f"{how} (ended as it was asked to)")
    assert [report.unfinished for report in run.core.reports()] == ["", "", how]


def test_component_that_dies_twice_at_the_end_is_reported_as_unfinished() -> None:
    run = Run()
    run.beat()
    run.exits("scheduler", ExitCode.ENDED)
    run.exits("series", -9)
    run.exits("series", -9)
    assert run.lines[-1].level == "WARNING"
    assert "before it had finished (killed by SIGKILL)" in run.lines[-1].text


def test_component_that_ends_in_time_is_finished() -> None:
    run = Run()
    run.beat()
    run.exits("scope", ExitCode.ENDED)
    run.step(TimePassed(), OWN_PACE_S)
    run.exits("series", ExitCode.ORPHAN)
    assert run.lines[-1].level == "DEBUG"
    assert not any(report.unfinished for report in run.core.reports())


def test_components_wait_for_the_scheduler_s_answer_within_a_limit() -> None:
    run = Run(awaits_scheduler=True)
    run.beat("scheduler")
    run.step(TimePassed(), SCHEDULER_ANSWERS_WITHIN_S - 0.1)
    assert run.others == []
    run.step(TimePassed(), 0.1)
    assert run.others == [ReleaseComponents()]
    run.step(SchedulerAnswered())
    assert run.others == [ReleaseComponents()]


@pytest.mark.parametrize(("works", "killed"), [(True, []), (False, [(KILL, "series")]), (None, [(KILL, "series")])])
def test_process_without_heartbeats_is_killed_unless_seen_to_work(
    works: bool | None, killed: list[tuple[ProcessAction, str]]
) -> None:
    run = Run(ChildSpec("series"))
    run.beat("series")
    for _ in range(3):
        assert run.step(TimePassed(), 0.9) == []
    assert run.core.overdue(run.now_s)[0] == {"series": run.pids["series"]}
    run.step(ActivitySeen("series", works))
    assert run.step(TimePassed(), 0.9) == killed


def test_restart_order_starts_a_process_that_was_given_up() -> None:
    run = Run()
    run.exits("series", ExitCode.CONFIG)
    critical = run.lines[-1]
    assert run.step(RestartOrdered("series")) == [(START, "series")]
    given_up, *later = (LogLine(1, one.name, one.level, one.text) for one in run.lines[run.lines.index(critical) :])
    assert given_up.is_alarm
    assert any(one.ends(given_up) for one in later)
    assert run.step(RestartOrdered("nobody")) == []
    report = run.core.reports()[2]
    assert (report.starts, report.ordered, report.given_up) == (2, 1, False)


def test_failing_start_is_retried_until_given_up() -> None:
    core = SupervisorCore([ChildSpec("series")], POLICY)
    core.step(RunBegan(), 0.0)
    start = ProcessCommand(START, "series")
    assert start in core.step(StartFailed("series", "no memory"), 0.0)
    core.step(StartFailed("series", "no memory"), 0.0)
    core.step(TimePassed(), 0.0)
    assert core.ending is not None
    assert core.ending.why is EndReason.LOST
    assert core.is_over


def test_next_deadline_lies_within_the_silence_limit() -> None:
    run = Run(ChildSpec("series"))
    run.beat("series")
    run.step(TimePassed())
    deadline_s = run.core.deadline_s()
    assert deadline_s is not None
    assert run.now_s < deadline_s <= run.now_s + 1.5


def test_exits_are_described() -> None:
    assert describe_exit(-signal.SIGTERM) == "killed by SIGTERM"
    assert describe_exit(ExitCode.CONFIG) == "its settings can't work"
    assert describe_exit(3) == "exit code 3"
    assert describe_exit(0xC0000005) == "killed by Windows: access violation (0xC0000005)"


PLANS = (ChildSpec("series", acts=True), ChildSpec("grid", acts=True))


class IdleRun(Run):
    """A run of two plans and a classifier; `rest` lets time pass without events."""

    def __init__(self, *, ends_idle: bool) -> None:
        super().__init__(*SPECS[:2], *PLANS, ChildSpec("classifier"), ends_idle=ends_idle)
        self.rest(1.0)

    def rest(self, for_s: float) -> None:
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.beat(*(name for name, child in self.core.children.items() if child.life))
            self.step(TimePassed(), 0.5)

    def logged(self, text: str) -> int:
        return sum(text in line.text for line in self.lines)


def test_nothing_left_to_run_is_logged_when_the_last_plan_is_done() -> None:
    run = IdleRun(ends_idle=False)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.CRASHED)
    run.rest(2 * IDLE_AFTER_S)
    assert run.logged("nothing is left to run") == 0
    run.exits("grid", ExitCode.DONE)
    run.rest(0.9 * IDLE_AFTER_S)
    assert run.logged("nothing is left to run") == 0
    run.rest(2 * IDLE_AFTER_S)
    assert run.logged("nothing is left to run: series is done, grid is done; Ctrl-C or `afspm end`") == 1
    assert run.others == []
    assert run.core.ending is None


def test_nothing_left_to_run_is_not_logged_after_a_component_has_ended_the_experiment() -> None:
    run = IdleRun(ends_idle=True)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.DONE)
    run.exits("classifier", ExitCode.ENDED)
    run.rest(2 * IDLE_AFTER_S)
    assert run.logged("nothing is left to run") == 0
    assert run.core.ending is not None
    assert run.core.ending.why is EndReason.EXPERIMENT_ENDED


def test_a_run_whose_plans_are_done_ends_once_the_microscope_is_not_in_use() -> None:
    run = IdleRun(ends_idle=True)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.DONE)
    run.rest(IDLE_AFTER_S + 1.0)
    assert run.others == [AskUse()]
    run.step(UseReported("Ada is in control"))
    run.rest(2 * ASK_AGAIN_S)
    assert run.logged("Ada is in control") == 1
    assert set(run.others) == {AskUse()}
    run.step(UseReported(""))
    assert run.others[-1] == EndExperiment()
    run.step(Beaten("classifier", Beat(step_age_s=0.5)))  # it finishes something
    run.step(TimePassed(), 0.5)
    run.exits("classifier", ExitCode.ENDED)
    assert run.core.ending is not None
    assert run.core.ending.why is EndReason.PLANS_DONE
    assert run.core.ending.text == "nothing was left to run: series is done, grid is done"
    assert (run.core.ending.why.exit_code, run.core.ending.why.is_final) == (3, True)


def test_a_run_whose_last_plan_was_given_up_ends_and_can_be_resumed() -> None:
    run = IdleRun(ends_idle=True)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.CONFIG, "no such channel")
    assert "gave up grid; the run ends in 10 s: no such channel" in run.lines[-1].text
    run.rest(IDLE_AFTER_S + 1.0)
    run.step(UseReported(""))
    assert run.core.ending is not None
    assert run.core.ending.why is EndReason.PLANS_LOST
    assert "series is done, grid was given up" in run.lines[-1].text
    assert (run.core.ending.why.exit_code, run.core.ending.why.is_final) == (4, False)
    assert (CLOSE, "classifier") in run.step(TimePassed())


def test_a_run_does_not_end_while_a_component_starts_again_or_a_plan_is_restarted() -> None:
    run = IdleRun(ends_idle=True)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.DONE)
    run.rest(IDLE_AFTER_S - 1.0)
    run.exits("classifier", ExitCode.CRASHED)
    run.rest(IDLE_AFTER_S - 1.0)
    assert run.others == []
    run.step(RestartOrdered("grid"))
    run.rest(2 * IDLE_AFTER_S)
    assert run.others == []


def test_refused_end_of_the_experiment_is_requested_again() -> None:
    run = IdleRun(ends_idle=True)
    run.exits("series", ExitCode.DONE)
    run.exits("grid", ExitCode.DONE)
    run.rest(IDLE_AFTER_S + 1.0)
    run.step(UseReported(""))
    run.step(EndRefused("not now"))
    assert run.logged("refuses to end the experiment: not now") == 1
    run.rest(2 * ASK_AGAIN_S)
    assert run.others[-1] == AskUse()


def test_the_recorder_leaves_after_the_other_components_and_before_the_scheduler() -> None:
    run = Run(*SPECS, ChildSpec("recorder", leaves_last=True))
    run.beat(*run.pids)
    run.exits("series", ExitCode.ENDED)
    assert run.step(TimePassed()) == []
    run.exits("scope", ExitCode.ENDED)
    run.step(Beaten("recorder", Beat(step_age_s=2.0)))
    assert run.step(TimePassed()) == [], "it writes"
    run.beat("recorder")
    assert run.step(TimePassed()) == [(CLOSE, "recorder")]
    run.exits("recorder", ExitCode.ENDED)
    assert run.step(TimePassed()) == [(CLOSE, "scheduler")]


def killed_after_s(run: Run, processor_share: float, *, works: bool | None = True) -> float:
    """Return the time from the request to end until `series`, with a share of a processor, is killed."""
    run.step(EndSignal(signal.SIGINT))
    assert run.step(TimePassed()) == [(CLOSE, "series")]
    asked_s = run.now_s
    while run.now_s < asked_s + 60.0:
        assert run.core.overdue(run.now_s)[0] == {"series": run.pids["series"]}
        run.step(ActivitySeen("series", works, 7.0 + processor_share * (run.now_s - asked_s)))
        if run.step(TimePassed(), 0.1):
            return run.now_s - asked_s
    raise AssertionError("it is never killed")


def test_process_that_works_on_its_end_has_longer_on_a_busy_computer_within_a_limit() -> None:
    assert killed_after_s(_only_series(), 0.0, works=False) == pytest.approx(KILL_AFTER_S, abs=0.2)
    assert killed_after_s(_only_series(), 0.0, works=None) == pytest.approx(KILL_AFTER_S, abs=0.2)
    slow = killed_after_s(_only_series(), CLOSES_WITHIN_S / 8.0)
    assert slow == pytest.approx(8.0 + KILL_AFTER_S, abs=0.3)
    assert killed_after_s(_only_series(), CLOSES_WITHIN_S / 60.0) == pytest.approx(TIP_S, abs=0.3)


def test_process_in_an_endless_loop_is_killed_soon_on_an_idle_computer() -> None:
    assert killed_after_s(_only_series(), 1.0) <= CLOSES_WITHIN_S + KILL_AFTER_S + 0.2


@pytest.mark.parametrize(("left", "waited_s"), [("series", KILL_AFTER_S), ("recorder", 1.0 + KILL_AFTER_S)])
def test_frozen_process_has_no_grace_after_the_end_of_other_processes(left: str, waited_s: float) -> None:
    run = Run(SPECS[0], ChildSpec("series"), ChildSpec("recorder", leaves_last=True))
    run.beat(*run.pids)
    run.step(EndSignal(signal.SIGINT))
    assert len(run.step(TimePassed())) == 3
    asked_s = run.now_s
    while run.now_s < asked_s + 1.0:  # the translator retracts the tip
        run.step(Beaten("scope", Beat(step_age_s=0.1)), 0.1)
        run.step(TimePassed())
    for name in {*run.pids} - {left}:
        run.exits(name, ExitCode.DONE)
    while not run.step(TimePassed(), 0.1):
        assert run.now_s < asked_s + 60.0
    assert run.commands[-1] == (KILL, left)
    assert run.now_s - asked_s == pytest.approx(waited_s, abs=0.25)


def _only_series() -> Run:
    run = Run(ChildSpec("series"))
    run.beat("series")
    return run


def test_component_restarted_at_the_end_has_time_on_a_busy_computer() -> None:
    """It was killed four seconds before the end: it starts slowly, then draws the night."""
    run = Run()
    run.beat()
    run.exits("series", -9)
    run.step(TimePassed(), 4.0)
    run.exits("scope", ExitCode.ENDED)
    for _ in range(200):
        run.step(ActivitySeen("series", True))
        assert (CLOSE, "series") not in run.step(TimePassed(), 0.1)
    assert run.core.overdue(run.now_s)[0]["series"] == run.pids["series"]
    run.beat("series", "scheduler")
    assert (CLOSE, "series") not in run.step(TimePassed(), 1.0), "it has yet to hear what it missed"
