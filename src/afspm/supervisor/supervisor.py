"""The supervisor: one poller for heartbeats, exits, output, signals and the next deadline.

`supervision.SupervisorCore` decides; the effects are carried out here.
"""

from __future__ import annotations

import logging
import math
import os
import secrets
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from afspm.basics.clock import ExperimentClock
from afspm.basics.errors import AfspmError, NoThread
from afspm.basics.exit_codes import ExitCode
from afspm.basics.formatting import duration_text
from afspm.basics.shared_time import TimeHold
from afspm.model import Role
from afspm.model.events import LOGGED_AS
from afspm.supervisor.activity_monitor import ActivityMonitor
from afspm.supervisor.child_output import OutputDropped, OutputLine
from afspm.supervisor.hold_watch import HoldWatch
from afspm.supervisor.log import LineReader, RunLog
from afspm.supervisor.process import ChildEvent, ChildProcess, Task
from afspm.supervisor.reaper import Reaper
from afspm.supervisor.reporter import Reporter, ReporterEvent, ReportFailed
from afspm.supervisor.supervision.child import ChildPolicy
from afspm.supervisor.supervision.process_status import ProcessStatus
from afspm.supervisor.supervision.run_end import EndReason
from afspm.supervisor.supervision.supervised_child import ChildSpec, ProcessReport
from afspm.supervisor.supervision.supervisor_core import SupervisorCore
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
    SupervisorEvent,
    TimePassed,
    UseReported,
    WriteLog,
)
from afspm.transport import keys
from afspm.transport.heartbeat import HeartbeatListener
from afspm.transport.polling import WakeUp
from afspm.transport.process import signals
from afspm.transport.process.failure import take_fault

REPORT_PERIOD_S = 0.1
"""Shortest real time between two updates of the reporter's process states."""
QUIET_REPORT_S = 0.5
"""Real time after which the states are updated without any event: a process may have become silent."""


@dataclass(frozen=True)
class RunOutcome:
    """Outcome of a run; `duration_s` is real time until the end begins, without the time that components then take.

    `waits_given_up`: how often simulated time went on without a process that was behind.
    """

    why: EndReason
    text: str
    reports: tuple[ProcessReport, ...]
    duration_s: float
    waits_given_up: int = 0

    @property
    def exit_code(self) -> int:
        return self.why.exit_code


class Supervisor:
    """A runner of a run's tasks, until the run ends by itself or a person stops the run."""

    def __init__(
        self,
        tasks: Sequence[Task],
        log: RunLog,
        clock: ExperimentClock,
        policy: ChildPolicy,
        reporter: Reporter | None = None,
        beats: HeartbeatListener | None = None,
        *,
        ends_idle: bool = False,
    ) -> None:
        self._log = log
        self._reporter = reporter
        self._clock = clock
        self._clock_check = ClockCheck(clock)
        self._hold_watch = HoldWatch(
            clock,
            lambda level, text: log.write(LOGGED_AS, level, text),
            lambda: {
                os.getpid(): "the start of all processes",
                **{process.pid: name for name, process in self._processes.items()},
            },
        )
        self._start_hold: TimeHold | None = None
        self._status = ProcessStatus(policy.liveness)
        self._reported_s = -math.inf
        self._is_unreported = True  # whether an event came since then
        self._wakeup: WakeUp[ChildEvent | EndSignal | ReporterEvent] = WakeUp()
        self._beats = beats or HeartbeatListener()
        self._beats.end_polls_by(self._wakeup.fileno())
        self._reaper = Reaper()
        self._tasks = {task.name: self._with_heartbeat(task) for task in tasks}
        self._processes: dict[str, ChildProcess] = {}
        self._lines = {task.name: LineReader() for task in tasks}
        self._monitors: dict[str, ActivityMonitor] = {}
        # without a reporter the scheduler's answer can't be seen
        awaits_scheduler = reporter is not None and any(task.role is Role.SCHEDULER for task in tasks)
        self._may_begin = threading.Event()
        if not awaits_scheduler:
            self._may_begin.set()
        specs = [
            ChildSpec(task.name, task.role, task.beats, task.leaves_last, task.acts, has_user_code=task.has_user_code)
            for task in tasks
        ]
        self._core = SupervisorCore(specs, policy, awaits_scheduler=awaits_scheduler, ends_idle=ends_idle)

    def _with_heartbeat(self, task: Task) -> Task:
        token, launch = secrets.token_hex(16), task.launch
        address, key = self._beats.listen(task.name, token=token, needs_token=bool(launch.class_))
        own = launch.keys if key is None else keys.with_server(launch.name, launch.keys, address, key)
        sockets = replace(launch.sockets, heartbeat=address)
        return replace(task, launch=replace(launch, beat_token=token, sockets=sockets, keys=own))

    def run(self) -> RunOutcome:
        """Start all processes, and return when none of them runs any more.

        Raises:
            NoThread: the system starts no further thread; no process is left.
        """
        began_s = self._clock.monotonic_s()
        self._reaper.begin()
        if self._reporter is not None:
            self._reporter.post = self._wakeup.post
            self._log.listener = self._reporter.line
            self._reporter.start()
        try:
            with signals.caught(self._on_signal, self._wakeup.writer_fileno()):
                # imports take seconds, which a fast clock would make half an hour without a scan
                self._start_hold = self._clock.hold()
                self._step(RunBegan())
                while not self._core.is_over:
                    self._wait()
                    self._look()
                    self._step(TimePassed())
                    self._report()
        finally:  # also after an error in this loop: no process may be left behind
            for process in self._processes.values():
                process.kill()
            self._end_start_hold()
            if self._reporter is not None:
                self._reporter.close()
            self._beats.close()
            self._wakeup.close()
            self._reaper.close()
        ending = self._core.ending
        assert ending is not None
        duration_s, given_up = ending.began_s - began_s, self._hold_watch.given_up
        return RunOutcome(ending.why, ending.text, self._core.reports(), duration_s, given_up)

    def stop(self) -> None:
        """End the run as Ctrl-C does, from any thread; a second call kills the processes at once."""
        self._wakeup.post(EndSignal(signal.SIGINT))

    # --- events ---

    def _on_signal(self, number: int) -> None:
        self._wakeup.post(EndSignal(number))

    def _wait(self) -> None:
        for beat in self._beats.poll(self._timeout_s()):
            self._step(Beaten(beat.name, beat))
        # Ctrl-C must not wait behind the output of the processes
        for event in sorted(self._wakeup.take(), key=lambda event: not isinstance(event, EndSignal)):
            match event:
                case OutputLine():
                    level, text = self._lines[event.name].read(event.stream, event.line)
                    self._log.write(event.name, level, text)
                case OutputDropped():
                    what = f"output limit exceeded; dropped {event.lines} lines"
                    self._log.write(event.name, logging.WARNING, what)
                case Exited():
                    self._on_exited(event)
                case EndSignal() | RestartOrdered() | SchedulerAnswered() | UseReported() | EndRefused():
                    self._step(event)
                case ReportFailed():
                    self._log.write(LOGGED_AS, logging.WARNING, event.text)

    def _timeout_s(self) -> float | None:
        deadlines = [self._core.deadline_s(), *(monitor.again_s for monitor in self._monitors.values())]
        if self._reporter is not None:
            period_s = REPORT_PERIOD_S if self._is_unreported else QUIET_REPORT_S
            deadlines.append(self._reported_s + period_s)
        soonest_s = min((s for s in deadlines if s is not None), default=None)
        return None if soonest_s is None else max(0.0, soonest_s - self._clock.monotonic_s())

    def _on_exited(self, exited: Exited) -> None:
        process = self._processes.get(exited.name)
        if process is not None and process.pid == exited.pid:
            del self._processes[exited.name]
            self._reaper.forget(exited.pid)
            state_dir = self._tasks[exited.name].launch.state_dir
            is_told = exited.code == ExitCode.OWN_FAULT and state_dir
            fault = take_fault(Path(state_dir), exited.name) if is_told else None
            self._step(replace(exited, last_error=self._lines[exited.name].last_error, fault=fault))

    def _look(self) -> None:
        if warning := self._clock_check.warning():
            self._log.write(LOGGED_AS, logging.WARNING, warning)
        self._hold_watch.look()
        now_s = self._clock.monotonic_s()
        if self._status.all_begun(self._core.children.values(), now_s):
            self._end_start_hold()
        overdue, lately_s = self._core.overdue(now_s)
        self._monitors = {
            name: self._monitors.get(name) or ActivityMonitor(pid, lately_s) for name, pid in overdue.items()
        }
        for name, monitor in self._monitors.items():
            self._step(ActivitySeen(name, monitor.work(now_s), monitor.processor_s))

    def _end_start_hold(self) -> None:
        # without a wait: a process may be frozen while it has the lock, and the next look tries again
        if self._start_hold is not None and self._clock.drop(self._start_hold):
            self._start_hold = None

    def _report(self) -> None:
        now_s = self._clock.monotonic_s()
        if self._reporter is None or now_s < self._reported_s + REPORT_PERIOD_S:
            return
        self._reported_s, self._is_unreported = now_s, False
        states, changed = self._status.states(self._core.children.values(), now_s, self._clock.now_ns())
        self._reporter.states(states, changed=changed)

    # --- effects ---

    def _step(self, event: SupervisorEvent) -> None:
        self._is_unreported |= not isinstance(event, TimePassed)
        for effect in self._core.step(event, self._clock.monotonic_s()):
            match effect:
                case WriteLog(name, level, text):
                    self._log.write(name, logging.getLevelNamesMapping()[level], text)
                case ReleaseComponents():
                    self._may_begin.set()
                case AskUse() | EndExperiment() if self._reporter is not None:
                    self._reporter.ask(effect)
                case ProcessCommand(ProcessAction.START, name):
                    self._start(name)
                case ProcessCommand(action, name) if name in self._processes:
                    self._carry_out(action, self._processes[name])

    def _carry_out(self, action: ProcessAction, process: ChildProcess) -> None:
        match action:
            case ProcessAction.KILL:
                process.kill()
            case ProcessAction.CLOSE_INPUT:
                process.close_stdin()
            case ProcessAction.ABANDON:
                del self._processes[process.name]

    def _start(self, name: str) -> None:
        if not self._core.may_start(name):
            return
        task = self._tasks[name]
        self._lines[name] = LineReader()
        self._monitors.pop(name, None)
        has_tip = task.role is Role.TRANSLATOR
        try:
            process = ChildProcess(task, self._wakeup.post, has_tip=has_tip, may_begin=self._may_begin_of(task))
        except AfspmError as error:
            if isinstance(error, NoThread) and not self._core.children[name].starts:
                raise  # in a run under way the system may have room later, at its start the limit is too low
            self._step(StartFailed(name, str(error)))
            return
        self._processes[name] = process
        self._reaper.watch(process.pid, has_tip=has_tip)
        self._step(ProcessStarted(name, process.pid))

    def _may_begin_of(self, task: Task) -> threading.Event | None:
        return self._may_begin if task.role is Role.COMPONENT else None


TOLERANCE_S = 5.0  # real time between the clocks of the computer and the run before the warning


class ClockCheck:
    """A check that warns once if experiment time and wall clock differ, in a run at real speed."""

    def __init__(self, clock: ExperimentClock) -> None:
        self._clock = clock
        self._is_done = clock.speed != 1.0

    def warning(self) -> str:
        """Compare the clocks now; return the warning, usually empty."""
        if self._is_done or abs(ahead_s := self._clock.wall_ahead_s()) < TOLERANCE_S:
            return ""
        self._is_done = True
        way = "ahead of" if ahead_s > 0.0 else "behind"
        return (
            f"the computer's clock is {duration_text(abs(ahead_s))} {way} the run's clock: it was set, or the "
            "computer slept; the record keeps the run's own time"
        )
