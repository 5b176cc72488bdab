"""The supervisor with real processes that end, crash, freeze, are busy, or refuse to end."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from systems import KILLED_FROM_OUTSIDE, WINE, freeze, kill, not_on_wine
from tests.system.supervisor.supervisor_lab import IMPATIENT, QUICK, RunTasks, peer

from afspm.basics.clock import ExperimentClock
from afspm.basics.exit_codes import ExitCode
from afspm.basics.file_lock import locked
from afspm.experiment import Role
from afspm.supervisor.process import Task
from afspm.supervisor.supervision.run_end import EndReason
from afspm.supervisor.supervision.supervisor_events import describe_exit

look_only = pytest.mark.skipif(
    WINE or sys.platform == "darwin", reason="the system does not tell the processor time of another process"
)


def test_run_with_all_processes_done_ends_with_success(run_tasks: RunTasks) -> None:
    outcome = run_tasks(peer("a", first="exit", code=0), peer("b", first="exit", code=0)).outcome()
    assert outcome.why is EndReason.ALL_DONE
    assert outcome.exit_code == 0
    assert [report.starts for report in outcome.reports] == [1, 1]


def test_crashed_process_is_restarted(run_tasks: RunTasks, tmp_path: Path) -> None:
    running = run_tasks(peer("a", first="crash", lives=str(tmp_path / "lives")))
    running.terminal.wait_for(" a ", "ERROR it breaks")
    running.terminal.wait_for(" a ", "life 2")
    assert running.stop().reports[0].starts == 2


def test_translator_that_ends_unannounced_counts_as_crashed_with_any_exit_code(
    run_tasks: RunTasks, tmp_path: Path
) -> None:
    lives = str(tmp_path / "lives")
    running = run_tasks(peer("scope", Role.TRANSLATOR, first="quit", lives=lives), peer("other"))
    running.terminal.wait_for(" scope ", "before the end of the experiment")
    running.terminal.wait_for(" scope ", "life 2")
    outcome = running.stop()
    assert (outcome.why, outcome.reports[0].starts) == (EndReason.STOPPED, 2)


def test_killed_process_is_restarted(run_tasks: RunTasks, tmp_path: Path) -> None:
    running = run_tasks(peer("a", lives=str(tmp_path / "lives")))
    running.terminal.wait_for(" a ", "life 1")
    kill(running.pid("a"))
    running.terminal.wait_for(" a ", describe_exit(KILLED_FROM_OUTSIDE))
    running.terminal.wait_for(" a ", "life 2")


def test_frozen_process_is_killed_and_restarted(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("a"))
    running.terminal.wait_for(" a ", "is up")
    freeze(running.pid("a"))
    running.terminal.wait_for(" a ", "no heartbeat")
    running.terminal.wait_for(" a ", "is up", count=2)


def test_process_busy_within_its_step_limit_keeps_running(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("a", first="busy", busy_s=2.0, longest_step_s=60.0))
    running.terminal.wait_for(" a ", "no longer busy")
    assert running.stop().reports[0].starts == 1


@look_only
def test_process_that_holds_pythons_lock_within_its_step_limit_keeps_running(run_tasks: RunTasks) -> None:
    busy_s = 1.25 * IMPATIENT.liveness.silence_s
    running = run_tasks(peer("a", first="grip", busy_s=busy_s, longest_step_s=600.0), policy=IMPATIENT)
    running.terminal.wait_for(" a ", "has let go")
    assert running.stop().reports[0].starts == 1


@look_only
def test_process_that_holds_pythons_lock_beyond_its_step_limit_is_killed(run_tasks: RunTasks, tmp_path: Path) -> None:
    lives = str(tmp_path / "lives")
    running = run_tasks(peer("a", first="grip", busy_s=600.0, longest_step_s=2.0, lives=lives))
    running.terminal.wait_for(" a ", "frozen")
    running.terminal.wait_for(" a ", "life 2")


@pytest.mark.parametrize("first", ["grip", "stuck"])
def test_idle_process_that_holds_pythons_lock_is_killed(run_tasks: RunTasks, tmp_path: Path, first: str) -> None:
    running = run_tasks(peer("a", first=first, busy_s=600.0, longest_step_s=600.0, lives=str(tmp_path / "lives")))
    if first == "grip":
        running.terminal.wait_for(" a ", "holds on")
        freeze(running.pid("a"))
    running.terminal.wait_for(" a ", "no heartbeat")
    running.terminal.wait_for(" a ", "life 2")


def test_process_busy_beyond_its_step_limit_is_killed(run_tasks: RunTasks, tmp_path: Path) -> None:
    lives = str(tmp_path / "lives")
    running = run_tasks(peer("a", first="busy", busy_s=600.0, longest_step_s=0.3, lives=lives))
    running.terminal.wait_for(" a ", "frozen")
    running.terminal.wait_for(" a ", "life 2")


def test_process_that_always_crashes_is_given_up_and_others_go_on(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("bad", first="crash"), peer("good"))
    running.terminal.wait_for("CRITICAL", "gave up bad", "the rest goes on")
    assert running.thread.is_alive()
    outcome = running.stop()
    bad, good = outcome.reports
    assert (bad.given_up, bad.starts) == (True, 3)  # once, and a budget of two restarts
    assert (good.given_up, good.starts) == (False, 1)


@pytest.mark.parametrize("role", [Role.SCHEDULER, Role.TRANSLATOR])
def test_run_without_scheduler_or_translator_ends_and_logs_why(run_tasks: RunTasks, role: Role) -> None:
    outcome = run_tasks(peer("vital", role, first="crash"), peer("other")).outcome()
    assert outcome.why is EndReason.LOST
    assert outcome.exit_code == 1
    assert "vital" in outcome.text


def test_run_with_all_processes_given_up_is_lost(run_tasks: RunTasks) -> None:
    assert run_tasks(peer("only", first="crash")).outcome().exit_code == 1


def test_process_with_wrong_settings_is_not_restarted(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("a", first="exit", code=78), peer("b"))
    running.terminal.wait_for("CRITICAL", "gave up a")
    report = running.stop().reports[0]
    assert (report.starts, report.given_up) == (1, True)


def test_missing_program_does_not_end_the_run(run_tasks: RunTasks) -> None:
    missing = replace(peer("missing"), command=("no-such-program",))
    running = run_tasks(missing, peer("good"))
    running.terminal.wait_for("CRITICAL", "gave up missing")
    running.terminal.wait_for(" good ", "life 1")
    assert not running.stop().reports[1].given_up


def test_end_of_the_experiment_also_ends_processes_that_ignore_it(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("ends", first="exit", code=80), peer("waits"), peer("deaf", first="deaf"))
    outcome = running.outcome()
    assert outcome.why is EndReason.EXPERIMENT_ENDED
    assert outcome.exit_code == 0
    assert [report.starts for report in outcome.reports] == [1, 1, 1]
    running.terminal.wait_for(" deaf ", "does not end: killed")


@pytest.mark.parametrize(
    ("how", "busy_s", "last_words"),
    [("busy", 4.0, "no longer busy"), pytest.param("grip", 2.5, "has let go", marks=look_only)],
)
def test_busy_process_may_finish_after_the_end_of_the_experiment(
    run_tasks: RunTasks, how: str, busy_s: float, last_words: str
) -> None:
    busy = peer("busy", first=how, busy_s=busy_s, longest_step_s=600.0)
    running = run_tasks(busy, peer("ends", first="exit", code=80), policy=IMPATIENT)
    assert running.outcome().reports[0].starts == 1
    running.terminal.wait_for(" busy ", last_words)
    running.terminal.wait_for("waiting for busy to finish", "Ctrl-C")


def test_component_that_works_too_long_after_the_end_is_reported_as_unfinished(
    run_tasks: RunTasks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("afspm.supervisor.supervision.run_end.FAREWELL_S", 4.0)
    busy = peer("busy", first="busy", busy_s=600.0, longest_step_s=900.0)
    running = run_tasks(busy, peer("ends", first="exit", code=80))
    assert "before it had finished" in running.outcome().reports[0].unfinished
    running.terminal.wait_for(" busy ", "WARNING", "files that it writes at the end may be missing")


def test_a_scheduler_that_is_done_ends_the_experiment(run_tasks: RunTasks) -> None:
    outcome = run_tasks(peer("scheduler", Role.SCHEDULER, first="exit", code=0), peer("waits")).outcome()
    assert outcome.why is EndReason.EXPERIMENT_ENDED


def test_component_that_is_done_does_not_end_the_experiment(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("done", first="exit", code=0), peer("waits"))
    running.terminal.wait_for(" done ", "done")
    assert running.stop().why is EndReason.STOPPED


def test_process_that_ignores_the_end_is_killed_and_others_end_by_themselves(run_tasks: RunTasks) -> None:
    """The benchmarks measure how long that takes."""
    running = run_tasks(peer("waits"), peer("deaf", first="deaf"))
    running.terminal.wait_for(" waits ", "life 1")
    running.terminal.wait_for(" deaf ", "life 1")
    outcome = running.stop()
    assert outcome.why is EndReason.STOPPED
    waits, deaf = outcome.reports
    assert waits.last_exit == "ended as it was asked to"  # by itself, since its stdin was closed
    assert deaf.last_exit != "ended as it was asked to"


def test_translator_that_retracts_the_tip_is_not_killed_meanwhile(run_tasks: RunTasks) -> None:
    scope = peer("scope", Role.TRANSLATOR, first="busy", busy_s=4.0, longest_step_s=60.0)
    running = run_tasks(scope, peer("other", first="busy", busy_s=600.0, longest_step_s=900.0))
    for name in ("scope", "other"):
        running.terminal.wait_for(f" {name} ", "is up")
    assert running.stop().why is EndReason.STOPPED
    running.terminal.wait_for(" scope ", "no longer busy")
    running.terminal.wait_for("waiting for scope", "to finish", "Ctrl-C")
    running.terminal.wait_for(" other ", "does not end: killed")
    assert not any(" scope " in line and "killed" in line for line in running.terminal.lines)


def test_second_stop_kills_at_once(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("scope", Role.TRANSLATOR, first="busy", busy_s=600.0, longest_step_s=900.0))
    running.terminal.wait_for(" scope ", "is up")
    running.supervisor.stop()
    running.terminal.wait_for("waiting for scope", "to finish")
    running.stop()


@not_on_wine("one that prints without end leaves the others hardly any time")
def test_stop_does_not_wait_behind_the_output_of_a_process(run_tasks: RunTasks) -> None:
    code = "import itertools, sys\nfor i in itertools.count(): print('waiting', i)"
    running = run_tasks(peer("quiet"), Task(peer("loud").launch, (sys.executable, "-c", code), beats=False))
    running.terminal.wait_for(" quiet ", "life 1")
    running.terminal.wait_for(" loud ", "waiting 1000")
    running.stop()
    assert running.outcome().why is EndReason.STOPPED


def test_nothing_is_restarted_while_the_run_ends(run_tasks: RunTasks, tmp_path: Path) -> None:
    deaf = peer("deaf", first="deaf", then="deaf", lives=str(tmp_path / "lives"))
    running = run_tasks(deaf)
    running.terminal.wait_for(" deaf ", "life 1")
    running.stop()
    assert (tmp_path / "lives").read_text() == "1"


def test_output_of_a_program_in_another_language_is_in_the_log(run_tasks: RunTasks) -> None:
    code = "import sys; print('to stdout'); print('to stderr', file=sys.stderr)"
    task = Task(peer("script").launch, (sys.executable, "-c", code))
    running = run_tasks(task)
    assert running.outcome().exit_code == 0
    running.terminal.wait_for(" script ", "to stdout")
    running.terminal.wait_for(" script ", "WARNING to stderr")


def test_program_without_heartbeats_is_not_killed_for_silence(run_tasks: RunTasks) -> None:
    """The same program, declared to send heartbeats, is killed for its silence."""
    silent = "import sys; sys.stdin.readline(); print('here', flush=True); sys.stdin.read()"
    deaf = replace(peer("program"), command=(sys.executable, "-c", silent), beats=False)
    policy = replace(QUICK, liveness=replace(QUICK.liveness, start_s=0.5))
    running = run_tasks(deaf, replace(deaf, launch=replace(deaf.launch, name="beating"), beats=True), policy=policy)
    running.terminal.wait_for(" beating ", "no first heartbeat", count=2)
    reports = {report.name: report.starts for report in running.stop().reports}
    assert reports["program"] == 1


# paper F6
def test_simulated_time_waits_for_the_first_heartbeats(run_tasks: RunTasks, tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=600.0).waiting_in(tmp_path / "clock")
    running = run_tasks(peer("begins"), _late(), clock=clock)
    running.terminal.wait_for(" late ", "here")
    assert _awaited(clock) == [os.getpid()]
    running.stop()
    assert _awaited(clock) == []


def test_simulated_time_waits_for_imports_that_heartbeats_report(run_tasks: RunTasks, tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=600.0).waiting_in(tmp_path / "clock")
    running = run_tasks(peer("loads", first="load", longest_step_s=1e3), clock=clock)
    running.terminal.wait_for(" loads ", "loads for ever")
    assert _awaited(clock) == [os.getpid()]
    kill(running.pid("loads"))
    running.pid("loads", life=2)
    kill(running.pid("loads", life=2))
    running.pid("loads", life=3)  # after a delay, in which the second life counts
    assert _awaited(clock) == []


# a child may be frozen while it holds the lock
def test_lock_of_the_shared_time_does_not_block_the_supervisor(run_tasks: RunTasks, tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=600.0).waiting_in(tmp_path / "clock")
    running = run_tasks(_late(), clock=clock)
    running.terminal.wait_for(" late ", "here")
    with (tmp_path / "clock").open("r+b") as file:
        with locked(file):
            kill(running.pid("late"))
            running.terminal.wait_for(" late ", "here", count=2)
            assert _awaited(clock) == [os.getpid()]
        kill(running.pid("late", life=2))
        running.pid("late", life=3)
        assert _awaited(clock) == []


def test_lock_of_the_shared_time_does_not_block_the_end(run_tasks: RunTasks, tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=600.0).waiting_in(tmp_path / "clock")
    running = run_tasks(_late(), clock=clock)
    running.terminal.wait_for(" late ", "here")
    with (tmp_path / "clock").open("r+b") as file, locked(file):
        assert running.stop().text.startswith("stopped by")


def test_simulated_time_does_not_wait_for_a_second_start(run_tasks: RunTasks, tmp_path: Path) -> None:
    clock = ExperimentClock.starting_now(speed=600.0).waiting_in(tmp_path / "clock")
    silent = replace(peer("silent"), command=(sys.executable, "-c", "import sys; sys.stdin.read()"))
    policy = replace(QUICK, liveness=replace(QUICK.liveness, start_s=0.5))
    # the third life comes after a delay, in which the supervisor has looked at the second
    run_tasks(peer("begins"), silent, policy=policy, clock=clock).pid("silent", life=3)
    assert _awaited(clock) == []


def _late() -> Task:
    silent = "import sys; sys.stdin.readline(); print('here', flush=True); sys.stdin.read()"
    return replace(peer("late"), command=(sys.executable, "-c", silent))


def _awaited(clock: ExperimentClock) -> list[int]:
    shared = clock.holds()
    assert shared is not None
    return [hold.pid for hold in shared.holds]


def test_scheduler_stopped_by_another_program_is_restarted(run_tasks: RunTasks) -> None:
    running = run_tasks(peer("scheduler", Role.SCHEDULER, first="exit", code=int(ExitCode.ORPHAN)))
    running.terminal.wait_for(" scheduler ", "restarting")
    assert running.stop().why is EndReason.STOPPED
