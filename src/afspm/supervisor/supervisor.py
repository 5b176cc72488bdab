"""The supervisor: one poller on heartbeats, exits, output, signals and the next deadline.

What to do about a child is decided by `logic.supervision.ChildWatch`, how a run ends by `ending`; here it is done.
"""

from __future__ import annotations

import logging
import math
import secrets
import signal
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from afspm.clock import ExperimentClock
from afspm.errors import AfspmError
from afspm.exit_codes import ExitCode
from afspm.experiment import Role
from afspm.logic.supervision import child as supervision
from afspm.logic.supervision.liveness import LivenessPolicy
from afspm.logic.supervision.run_end import EndReason, EndStep, RunEnd
from afspm.logic.supervisor_registry import LOGGED_AS
from afspm.supervisor import signals
from afspm.supervisor.activity_monitor import ActivityMonitor
from afspm.supervisor.clock_check import ClockCheck
from afspm.supervisor.log import LineReader, RunLog
from afspm.supervisor.process import ChildEvent, ChildProcess, Exited, LeftOut, Printed, describe_exit
from afspm.supervisor.process_status import ProcessStatus
from afspm.supervisor.reaper import Reaper
from afspm.supervisor.reporter import Reporter, ReporterEvent, ReportFailed, RestartOrdered, SchedulerAnswered
from afspm.supervisor.task import Task
from afspm.transport.heartbeat import Heartbeat, HeartbeatListener
from afspm.transport.wakeup import WakeUp

# why the run ends, told at once; that it has ended as it should the summary tells in a moment
_LEVELS = {EndReason.STOPPED: logging.INFO, EndReason.LOST: logging.CRITICAL}


LOOK_S = 0.1  # between two looks at how it is with the processes, for those who are told
BEGIN_ANYWAY_S = 15.0  # after which components no longer wait for the scheduler to answer
START_AT_THE_END_S = 15.0  # what is started again at the end has so long to come up, and to hear what it missed


@dataclass(frozen=True)
class ProcessReport:
    """What became of one process: how often it was started, of that how often since it was ordered, whether it was
    given up, how it ended last."""

    name: str
    starts: int
    given_up: bool
    last_exit: str
    ordered: int = 0


@dataclass(frozen=True)
class RunOutcome:
    """How a run ended."""

    why: EndReason
    text: str
    reports: tuple[ProcessReport, ...]
    duration_s: float

    @property
    def exit_code(self) -> int:
        """Of `afspm run`."""
        return self.why.exit_code


@dataclass
class _Child:
    task: Task
    watch: supervision.ChildWatch
    process: ChildProcess | None = None
    lines: LineReader = field(default_factory=LineReader)
    starts: int = 0
    ordered: int = 0
    started_s: float = 0.0
    rescued: bool = False
    up: bool = False
    beat: Heartbeat | None = None
    beat_s: float = 0.0
    signs: ActivityMonitor | None = None
    works: bool | None = None  # though it does not beat; None: that is not known
    given_up: bool = False
    last_exit: str = ""
    last_error: str = ""

    @property
    def name(self) -> str:
        return self.task.name

    def is_busy(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Whether it works on a step, as its last beat says or is seen, and for no longer than it declared."""
        if self.process is None or self.beat is None or self.beat.closing:
            return False
        longest_s, age_s = self.beat.longest_step_s or liveness.longest_step_s, self.beat.step_age_s or 0.0
        silent_s = now_s - self.beat_s
        if silent_s >= liveness.silence_s:
            return bool(self.works) and age_s + silent_s <= longest_s
        return 0.0 < age_s <= longest_s

    def look(self, now_s: float, liveness: LivenessPolicy) -> None:
        """See whether it works, if a beat is overdue."""
        lately_s = liveness.silence_s / 2.0
        if self.process is None or not self.up or now_s < self.beat_s + lately_s:
            self.signs = self.works = None
            return
        self.signs = self.signs or ActivityMonitor(self.process.pid, lately_s)
        self.works = self.signs.work(now_s)

    def look_at_s(self, liveness: LivenessPolicy) -> float | None:
        """When to look next, if no beat comes: before it is too late, since a single look says little."""
        if self.process is None or self.beat is None or self.beat.closing:
            return None
        return self.beat_s + liveness.silence_s / 2.0 if self.signs is None else self.signs.again_s

    def may_still_finish(self, now_s: float, liveness: LivenessPolicy, *, can_hear: bool) -> bool:
        """Whether it is too early to say that it has nothing left to do: it starts, has not beaten for a moment, is
        frozen and can be started again, or was, and has yet to hear what it missed, if it still can."""
        if self.process is None or not self.task.beats or self.task.role is not Role.COMPONENT:
            return False
        if not self.up:
            return now_s - self.started_s < START_AT_THE_END_S
        closing = self.beat is not None and self.beat.closing
        given_up = self.rescued and self.is_silent(now_s, liveness)
        # between two steps of its start it looks as if it had nothing to do
        begins_anew = can_hear and self.starts > 1 and now_s - self.started_s < START_AT_THE_END_S
        is_late = now_s - self.beat_s > 1.5 * liveness.beat_period_s
        return not closing and not given_up and (begins_anew or is_late)

    def is_silent(self, now_s: float, liveness: LivenessPolicy) -> bool:
        """Whether it should have beaten long ago, and does not work either."""
        beating = self.process is not None and self.up and self.beat is not None and not self.beat.closing
        return beating and now_s - self.beat_s >= liveness.silence_s and not self.is_busy(now_s, liveness)

    def ended_too_soon(self, code: int) -> bool:
        """Whether it has crashed though its exit code says that it is done: a translator never is, and one of version 1
        that has caught an error of its own ends like that. One that closes on purpose says so by its last beat."""
        said = self.beat is not None and self.beat.closing
        return code == ExitCode.DONE and self.task.role is Role.TRANSLATOR and not said

    @property
    def over(self) -> bool:
        return self.given_up or self.watch.over


class Supervisor:
    """Runs tasks until the experiment ends, everything is done, something essential is lost, or it is stopped."""

    def __init__(
        self,
        tasks: Sequence[Task],
        log: RunLog,
        clock: ExperimentClock,
        policy: supervision.ChildPolicy,
        reporter: Reporter | None = None,
    ) -> None:
        self._log = log
        self._reporter = reporter
        self._standing = ProcessStatus(clock, policy.liveness)
        self._looked_s = -math.inf
        self._clock = clock
        self._wall = ClockCheck(clock, lambda text: log.write(LOGGED_AS, logging.WARNING, text))
        self._policy = policy
        self._wakeup: WakeUp[ChildEvent | signals.EndSignal | ReporterEvent] = WakeUp()
        self._beats = HeartbeatListener(self._wakeup)
        self._reaper = Reaper()
        self._children = {task.name: self._child(task) for task in tasks}
        self._ending: RunEnd | None = None
        self._scheduler_is_there = threading.Event()
        if reporter is None or all(task.role is not Role.SCHEDULER for task in tasks):
            self._scheduler_is_there.set()  # or nobody here can tell
        self._has_told_waiting = False

    def _child(self, task: Task) -> _Child:
        token = secrets.token_hex(16)
        address = self._beats.listen(task.name, token=token, needs_token=bool(task.launch.class_))
        watch = supervision.ChildWatch(replace(self._policy, beats=task.beats))
        launch = replace(task.launch, beat_token=token, sockets=replace(task.launch.sockets, heartbeat=address))
        return _Child(replace(task, launch=launch), watch)

    def run(self) -> RunOutcome:
        """Start everything; returns when nothing of it runs any more."""
        began_s = self._clock.monotonic_s()
        self._reaper.begin()
        if self._reporter is not None:
            self._reporter.post = self._wakeup.post
            self._log.listener = self._reporter.line
            self._reporter.start()
        try:
            with signals.told(self._wakeup.post, self._wakeup.writer_fileno()):
                for child in self._children.values():
                    self._carry_out(child, child.watch.begin(began_s))
                while self._ending is None or any(child.process for child in self._children.values()):
                    self._wait()
                    self._attend()
                    self._report()
        finally:  # also when an error of ours ends it: nothing may be left behind
            for child in self._children.values():
                if child.process:
                    child.process.kill()
            if self._reporter is not None:
                self._reporter.close()
            self._beats.close()
            self._wakeup.close()
            self._reaper.close()
        reports = tuple(
            ProcessReport(child.name, child.starts, child.given_up, child.last_exit, child.ordered)
            for child in self._children.values()
        )
        return RunOutcome(self._ending.why, self._ending.text, reports, self._clock.monotonic_s() - began_s)

    def stop(self) -> None:
        """End the run as Ctrl-C does. From any thread; a second call kills at once."""
        self._wakeup.post(signals.EndSignal(signal.SIGINT))

    # --- what comes in ---

    def _wait(self) -> None:
        """Wait for whatever comes first, and take all of it in."""
        beats = self._beats.poll(self._timeout_s())
        now_s = self._clock.monotonic_s()
        for beat in beats:
            child = self._children[beat.name]
            child.beat, child.beat_s = beat, now_s
            if not child.up:
                child.up = True
                self._log.write(child.name, logging.DEBUG, "is up")
            self._carry_out(child, child.watch.beat(beat, now_s))
        # whoever wants it to end does not wait behind what the processes say
        for event in sorted(self._wakeup.take(), key=lambda event: not isinstance(event, signals.EndSignal)):
            match event:
                case Printed():
                    self._on_printed(self._children[event.name], event)
                case LeftOut():
                    told = f"says more than can be kept: {event.lines} lines are left out here"
                    self._log.write(event.name, logging.WARNING, told)
                case Exited():
                    self._on_exited(self._children[event.name], event)
                case signals.EndSignal():
                    self._on_signal(event)
                case RestartOrdered():
                    self._on_ordered(event.name)
                case SchedulerAnswered():
                    self._scheduler_is_there.set()
                case ReportFailed():
                    self._log.write(LOGGED_AS, logging.WARNING, event.text)

    def _timeout_s(self) -> float | None:
        """How long there is nothing to do if nothing happens; None: for ever."""
        now_s = self._clock.monotonic_s()
        if self._ending:
            deadlines = [self._ending.deadline_s()]
        else:
            deadlines = [child.watch.deadline_s() for child in self._children.values()]
        deadlines += [child.look_at_s(self._policy.liveness) for child in self._children.values()]
        if self._reporter is not None:
            deadlines = [*deadlines, self._looked_s + LOOK_S]
        soonest_s = min((s for s in deadlines if s is not None), default=None)
        return None if soonest_s is None else max(0.0, soonest_s - now_s)

    def _on_printed(self, child: _Child, printed: Printed) -> None:
        level, text = child.lines.read(printed.stream, printed.line)
        child.last_error = child.lines.last_error
        self._log.write(child.name, level, text)

    def _on_exited(self, child: _Child, exited: Exited) -> None:
        if child.process is None or child.process.pid != exited.pid:
            return
        child.process = None
        self._reaper.forget(exited.pid)
        how = describe_exit(exited.code)
        child.last_exit = f"{how}: {child.last_error}" if exited.code == ExitCode.CRASHED and child.last_error else how
        if self._ending is not None:
            if child.watch.died(exited.code) and self._may_be_rescued(child):
                self._log.write(child.name, logging.WARNING, f"{how}; it is started again, to finish")
                self._rescue(child)
            else:
                self._log.write(child.name, logging.DEBUG, child.last_exit)
            return
        if child.ended_too_soon(exited.code):
            told = f"{how}, before the experiment has ended and without saying that it closes"
            self._carry_out(child, child.watch.exited(ExitCode.CRASHED, self._clock.monotonic_s(), told))
            return
        self._carry_out(child, child.watch.exited(exited.code, self._clock.monotonic_s(), how))
        if exited.code == ExitCode.ENDED:
            self._end(EndReason.EXPERIMENT_ENDED, "the experiment has ended")
        elif exited.code == ExitCode.CONFIG:
            self._give_up(child, child.last_error or "its settings can't work")
        elif exited.code == ExitCode.DONE and child.task.essential:
            self._end(EndReason.EXPERIMENT_ENDED, f"{child.name} is done")

    def _on_signal(self, signalled: signals.EndSignal) -> None:
        if self._ending is None:
            self._end(EndReason.STOPPED, f"stopped by {signalled.name}")
        else:
            self._ending = self._ending.hurried(self._clock.monotonic_s())

    def _on_ordered(self, name: str) -> None:
        child = self._children.get(name)
        if child is None or self._ending is not None:
            return
        child.given_up, child.ordered = False, child.ordered + 1
        self._carry_out(child, child.watch.restart(self._clock.monotonic_s()))

    # --- what is done about it ---

    def _report(self) -> None:
        """Look how it is with all processes, now and then, and have it told."""
        now_s = self._clock.monotonic_s()
        if self._reporter is None or now_s < self._looked_s + LOOK_S:
            return
        self._looked_s = now_s
        states, changed = self._standing.of(self._children.values(), now_s)
        self._reporter.states(states, changed=changed)

    def _attend(self) -> None:
        """Do what the time has come for."""
        self._wall.look()
        now_s = self._clock.monotonic_s()
        self._begin_anyway(now_s)
        for child in self._children.values():
            child.look(now_s, self._policy.liveness)
        if self._ending is not None:
            self._go_on_ending(self._ending, now_s)
            return
        for child in self._children.values():
            self._carry_out(child, child.watch.tick(now_s, works=child.works))
        if self._ending is None and all(child.over for child in self._children.values()):
            if all(child.given_up for child in self._children.values()):
                self._end(EndReason.LOST, "everything is given up")
            else:
                self._end(EndReason.ALL_DONE, "all is done")

    def _begin_anyway(self, now_s: float) -> None:
        """A scheduler that beats and does not answer us, for want of a key perhaps, may answer components."""
        if self._scheduler_is_there.is_set():
            return
        for child in self._children.values():
            if child.task.role is Role.COMPONENT:
                child.watch.waits(now_s)
        if any(
            child.task.role is Role.SCHEDULER and child.up and now_s - child.started_s >= BEGIN_ANYWAY_S
            for child in self._children.values()
        ):
            self._scheduler_is_there.set()
            self._log.write(
                LOGGED_AS, logging.WARNING, "the scheduler does not answer; the components begin all the same"
            )

    def _carry_out(self, child: _Child, effects: Sequence[supervision.ChildEffect]) -> None:
        for effect in effects:
            match effect:
                case supervision.StartChild():
                    self._start(child)
                case supervision.KillChild():
                    if child.process:
                        child.process.kill()
                case supervision.ChildLog(level, text):
                    self._log.write(child.name, logging.getLevelNamesMapping()[level], text)
                case supervision.GiveUpChild(why):
                    self._give_up(child, why)

    def _start(self, child: _Child) -> None:
        if self._ending is not None and not child.rescued:
            return
        task = child.task
        child.lines, child.up, child.beat, child.last_error = LineReader(), False, None, ""
        child.starts += 1
        child.started_s = self._clock.monotonic_s()
        try:
            child.process = ChildProcess(
                task.name,
                task.command,
                task.launch.to_json(),
                self._wakeup.post,
                task.environment,
                task.folder,
                task.hidden,
                has_tip=task.role is Role.TRANSLATOR,
                may_begin=self._scheduler_is_there if task.role is Role.COMPONENT else None,
            )
            self._reaper.watch(child.process.pid, has_tip=task.role is Role.TRANSLATOR)
            self._log.write(child.name, logging.DEBUG, f"started, process {child.process.pid}")
        except AfspmError as error:
            child.last_exit = f"could not be started: {error}"
            self._carry_out(child, child.watch.start_failed(str(error), self._clock.monotonic_s()))

    def _give_up(self, child: _Child, why: str) -> None:
        child.given_up = True
        if child.task.essential:
            self._end(EndReason.LOST, f"{child.name} is given up, and the experiment can't go on without it: {why}")
        else:
            told = f"{child.name} is given up, the rest goes on (Ctrl-C ends it): {why}"
            self._log.write(LOGGED_AS, logging.CRITICAL, told)

    def _end(self, why: EndReason, text: str) -> None:
        self._scheduler_is_there.set()
        if self._ending is None:
            now_s = self._clock.monotonic_s()
            self._ending = RunEnd.begin(why, text, now_s)
            for child in self._children.values():
                is_missing = child.process is None and child.watch.phase is supervision.ChildPhase.WAITING
                child.watch.stop(now_s)
                if is_missing and self._may_be_rescued(child):
                    self._rescue(child)
                # the signal that the experiment has ended is the scheduler's, whom a translator does not listen to
                if child.task.role is Role.TRANSLATOR and child.process:
                    child.process.close_stdin()
            self._log.write(LOGGED_AS, _LEVELS.get(why, logging.DEBUG), text)

    def _look_after_the_last(self, now_s: float) -> None:
        """At the end of the experiment: kill who is frozen, and let the scheduler go once nobody needs it any more."""
        left = [child for child in self._children.values() if child.process is not None]
        for child in left:
            if child.task.role is Role.SCHEDULER and all(other.task.role is Role.SCHEDULER for other in left):
                assert child.process is not None
                child.process.close_stdin()
            elif self._may_be_rescued(child) and child.is_silent(now_s, self._policy.liveness):
                assert child.process is not None
                child.process.kill()

    def _may_be_rescued(self, child: _Child) -> bool:
        """Whether it is started once more though the experiment has ended: it had not finished when it died."""
        ending = self._ending
        return (
            ending is not None
            and ending.why is EndReason.EXPERIMENT_ENDED
            and ending.last is None
            and child.task.beats
            and child.task.role is Role.COMPONENT
            and not child.rescued
        )

    def _rescue(self, child: _Child) -> None:
        child.rescued = True
        self._start(child)

    def _waited_for(self, ending: RunEnd, now_s: float) -> list[str]:
        """The names of those who have something to finish; a translator has after it was asked to end, too: the tip."""
        liveness = self._policy.liveness
        is_asked, has_ended = ending.last is not None, ending.why is EndReason.EXPERIMENT_ENDED
        # a scheduler on another computer may be there
        can_hear = all(child.process for child in self._children.values() if child.task.role is Role.SCHEDULER)
        return [
            child.name
            for child in self._children.values()
            if (child.is_busy(now_s, liveness) and (not is_asked or child.task.role is Role.TRANSLATOR))
            or (child.may_still_finish(now_s, liveness, can_hear=can_hear) and has_ended and not is_asked)
        ]

    def _go_on_ending(self, ending: RunEnd, now_s: float) -> None:
        if ending.last is None and ending.why is EndReason.EXPERIMENT_ENDED:
            self._look_after_the_last(now_s)
        busy = self._waited_for(ending, now_s)
        self._ending, do = ending.step(now_s, busy=bool(busy))
        if busy and self._ending.deadline_s() != ending.deadline_s() and do is None and not self._has_told_waiting:
            self._has_told_waiting = True
            told = f"waiting for {', '.join(busy)} to finish; Ctrl-C ends it now"
            self._log.write(LOGGED_AS, logging.INFO, told)
        for child in self._children.values():
            if child.process is None:
                continue
            match do:
                case EndStep.ASK:
                    child.process.close_stdin()
                case EndStep.KILL:
                    self._log.write(child.name, logging.WARNING, "does not end: killed")
                    child.process.kill()
                case EndStep.LEAVE:
                    self._log.write(child.name, logging.CRITICAL, f"can't be killed (process {child.process.pid})")
                    child.process = None
