"""Decisions of the supervisor about all processes of a run. Pure: events and real monotonic times in, effects out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from afspm.basics.exit_codes import ExitCode
from afspm.basics.formatting import duration_text
from afspm.model import Role
from afspm.model.events import LOGGED_AS, NO_LONGER_TRUE
from afspm.supervisor.supervision.child import (
    ChildEffect,
    ChildLog,
    ChildPhase,
    ChildPolicy,
    ChildWatch,
    GiveUpChild,
    HeartbeatReport,
    KillChild,
    StartChild,
)
from afspm.supervisor.supervision.run_end import (
    IDLE_AFTER_S,
    EndReason,
    EndStep,
    IdleWatch,
    RunEnd,
    describe_idle,
    unfinished,
)
from afspm.supervisor.supervision.supervised_child import ChildLife, ChildSpec, ProcessReport, SupervisedChild
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

SCHEDULER_ANSWERS_WITHIN_S = 15.0
"""Time from the scheduler's start, after which components start although the scheduler has not answered."""


class SupervisorCore:
    """Decisions on processes to start, to kill and to ask to end, and on lines to log.

    Args:
        awaits_scheduler: whether components begin only after the scheduler has answered.
        ends_idle: whether the run ends once no process with a plan is left.

    Attributes:
        ending: state of the end of the run; None until the end begins.
    """

    def __init__(
        self,
        specs: Iterable[ChildSpec],
        policy: ChildPolicy,
        *,
        awaits_scheduler: bool = False,
        ends_idle: bool = False,
    ) -> None:
        self.children = {
            spec.name: SupervisedChild(spec, ChildWatch(replace(policy, beats=spec.beats))) for spec in specs
        }
        self.ending: RunEnd | None = None
        self._liveness = policy.liveness
        self._awaits_scheduler = awaits_scheduler
        self._idle = IdleWatch(ends_idle)
        self._has_told_waiting = False
        self._waited_for: set[str] = set()  # processes that were busy after the request to end
        self._effects: list[SupervisorEffect] = []
        self._now_s = 0.0

    @property
    def is_over(self) -> bool:
        return self.ending is not None and not any(child.life for child in self.children.values())

    def step(self, event: SupervisorEvent, now_s: float) -> list[SupervisorEffect]:
        """Process an event at a real monotonic time; return the effects in order."""
        self._now_s = now_s
        match event:
            case RunBegan():
                for child in self.children.values():
                    self._apply(child, child.watch.begin(now_s))
            case ProcessStarted(name, pid):
                self.children[name].starts += 1
                self.children[name].life = ChildLife(pid, now_s)
                self._log(name, "DEBUG", f"started, process {pid}")
            case StartFailed(name, why):
                child = self.children[name]
                child.starts += 1
                child.last_exit = f"could not be started: {why}"
                self._apply(child, child.watch.start_failed(why, now_s))
            case Beaten(name, report):
                self._on_beat(self.children[name], report)
            case ActivitySeen():
                self._on_activity(self.children[event.name], event)
            case Exited():
                self._on_exit(self.children[event.name], event)
            case EndSignal() if self.ending is None:
                self._end(EndReason.STOPPED, f"stopped by {event.name}")
            case EndSignal():
                assert self.ending is not None
                self.ending = self.ending.hurried(now_s)
            case RestartOrdered(name):
                self._on_order(name)
            case SchedulerAnswered():
                self._release()
            case UseReported(why):
                self._on_use(why)
            case EndRefused(why):
                self._idle.is_ending = False
                self._log(LOGGED_AS, "WARNING", f"the scheduler refuses to end the experiment: {why}")
            case TimePassed():
                self._on_time()
        effects, self._effects = self._effects, []
        return effects

    def may_start(self, name: str) -> bool:
        """Return whether a process may still be started: false once the run is ending."""
        return self.ending is None or self.children[name].rescued

    def deadline_s(self) -> float | None:
        """Return the latest time for the next `TimePassed`; None if there is no deadline."""
        if self.ending is not None:
            found = [self.ending.deadline_s()]
        else:
            found = [self._idle.deadline_s(), *(child.watch.deadline_s() for child in self.children.values())]
        for child in self.children.values():
            if child.life is not None and not child.life.is_overdue(self._now_s, self._liveness):
                found.append(child.life.overdue_s(self._liveness))
        return min((s for s in found if s is not None), default=None)

    def overdue(self, now_s: float) -> tuple[dict[str, int], float]:
        """Return the process ids to sample for activity, by name, and the time span to judge, in s.

        These are processes with a late heartbeat; at the end of a run also starting processes, and all processes that
        were asked to end.
        """
        overdue: dict[str, int] = {}
        for name, child in self.children.items():
            if child.life is None:
                continue
            is_late_to_finish = self.ending is not None and (self._is_asked or child.life.beat is None)
            if is_late_to_finish or child.life.is_overdue(now_s, self._liveness):
                overdue[name] = child.life.pid
            else:
                child.life.works = None
        return overdue, self._liveness.silence_s / 2.0

    def reports(self) -> tuple[ProcessReport, ...]:
        return tuple(
            ProcessReport(
                name,
                child.starts,
                child.given_up,
                child.last_exit,
                child.ordered,
                child.unfinished,
                child.misconfigured,
            )
            for name, child in self.children.items()
        )

    # --- events ---

    @property
    def _is_asked(self) -> bool:
        return self.ending is not None and self.ending.last is EndStep.ASK

    def _on_activity(self, child: SupervisedChild, seen: ActivitySeen) -> None:
        if child.life is None:
            return
        child.life.works, child.life.processor_s = seen.works, seen.processor_s
        if self._is_asked and child.life.asked_processor_s is None:
            child.life.asked_processor_s = seen.processor_s

    def _on_beat(self, child: SupervisedChild, report: HeartbeatReport) -> None:
        if child.life is not None:
            if child.life.beat is None:
                self._log(child.spec.name, "DEBUG", "is up")
                child.life.first_beat_s = self._now_s
            child.life.beat, child.life.beat_s = report, self._now_s
        self._apply(child, child.watch.beat(report, self._now_s))

    def _on_exit(self, child: SupervisedChild, exited: Exited) -> None:
        life, code = child.life, exited.code
        if life is None or life.pid != exited.pid:
            return
        child.life = None
        how = describe_exit(code)
        has_crashed = code in (ExitCode.CRASHED, ExitCode.OWN_FAULT)
        child.last_exit = f"{how}: {exited.last_error}" if has_crashed and exited.last_error else how
        if self.ending is not None:
            if child.watch.died(code) and self._may_be_rescued(child):
                self._log(child.spec.name, "WARNING", f"{how}; restarting it, to finish")
                self._rescue(child)
            elif self._is_unfinished(child, life, code):
                after = duration_text(self._now_s - self.ending.began_s)
                child.unfinished = f"stopped {after} after the end of the experiment, before it had finished"
                what = f"{child.unfinished} ({child.last_exit}): files that it writes at the end may be missing"
                self._log(child.spec.name, "WARNING", what)
            else:
                self._log(child.spec.name, "DEBUG", child.last_exit)
        elif code == ExitCode.DONE and child.spec.role is Role.TRANSLATOR and not life.is_closing:
            # a program in another language ends like this after an error that it caught; a regular end is announced
            told = f"{how} before the end of the experiment, without announcing it"
            self._apply(child, child.watch.exited(ExitCode.CRASHED, self._now_s, told))
        else:
            self._apply(child, child.watch.exited(code, self._now_s, how, exited.fault))
            if has_crashed:
                self._advise(child)
            if code == ExitCode.ENDED:
                self._end_announced()
            elif code == ExitCode.CONFIG:
                child.misconfigured = True
                self._give_up(child, exited.last_error or "its settings can't work")
            elif code == ExitCode.DONE and child.spec.essential:
                self._end(EndReason.EXPERIMENT_ENDED, f"{child.spec.name} is done")

    def _end_announced(self) -> None:
        if self._idle.is_ending:
            self._end(EndReason.PLANS_DONE, f"nothing was left to run: {describe_idle(self.children.values())}")
        else:
            self._end(EndReason.EXPERIMENT_ENDED, "the experiment has ended")

    def _check_idle(self) -> None:
        if not self._idle.look(self.children.values(), self._now_s, self._liveness):
            return
        if not self._idle.is_logged:
            self._idle.is_logged = True
            if not self._idle.ends:  # otherwise the end says so
                why = describe_idle(self.children.values())
                self._log(
                    LOGGED_AS, "INFO", f"nothing is left to run: {why}; Ctrl-C or `afspm end` ends the experiment"
                )
        if self._idle.asks(self._now_s):
            self._effects.append(AskUse())

    def _on_use(self, why: str) -> None:
        if self.ending is not None or not self._idle.is_logged or self._idle.is_ending:
            return
        if why:
            if not self._idle.is_postponed:
                self._idle.is_postponed = True
                over = describe_idle(self.children.values())
                goes_on = f"nothing is left to run: {over}; the experiment goes on as long as it is in use: {why}"
                self._log(LOGGED_AS, "INFO", goes_on)
        elif any(child.given_up for child in self.children.values() if child.spec.acts):
            self._end(EndReason.PLANS_LOST, f"nothing is left to run: {describe_idle(self.children.values())}")
        else:
            self._idle.is_ending = True
            self._effects.append(EndExperiment())

    def _on_order(self, name: str) -> None:
        child = self.children.get(name)
        if child is None or self.ending is not None:
            return
        if child.given_up:
            self._log(LOGGED_AS, "INFO", f"{name} is started again; {NO_LONGER_TRUE}gave up {name}")
        child.given_up, child.ordered = False, child.ordered + 1
        self._apply(child, child.watch.restart(self._now_s))

    def _on_time(self) -> None:
        self._await_scheduler()
        if self.ending is not None:
            self._continue_ending(self.ending)
            return
        for child in self.children.values():
            works = None if child.life is None else child.life.works
            self._apply(child, child.watch.tick(self._now_s, works=works))
        if self.ending is None and all(child.is_over for child in self.children.values()):
            if all(child.given_up for child in self.children.values()):
                self._end(EndReason.LOST, "all processes are given up")
            else:
                self._end(EndReason.ALL_DONE, "all components are done")
        if self.ending is None:
            self._check_idle()

    def _await_scheduler(self) -> None:
        # a scheduler that beats but does not answer us (for want of a key, perhaps) may still answer the components
        if not self._awaits_scheduler:
            return
        for child in self._with_role(Role.COMPONENT):
            child.watch.waits(self._now_s)
        lives = [child.life for child in self._with_role(Role.SCHEDULER)]
        if any(life and life.beat and self._now_s - life.started_s >= SCHEDULER_ANSWERS_WITHIN_S for life in lives):
            self._release()
            self._log(LOGGED_AS, "WARNING", "the scheduler does not answer; the components are started nevertheless")

    # --- one child ---

    def _apply(self, child: SupervisedChild, effects: Sequence[ChildEffect]) -> None:
        for effect in effects:
            match effect:
                case StartChild():
                    self._start(child)
                case KillChild() if child.life is not None:
                    self._command(ProcessAction.KILL, child)
                case ChildLog(level, text):
                    self._log(child.spec.name, level, text)
                case GiveUpChild(why):
                    self._give_up(child, why)

    def _start(self, child: SupervisedChild) -> None:
        if self.may_start(child.spec.name):
            self._command(ProcessAction.START, child)

    def _give_up(self, child: SupervisedChild, why: str) -> None:
        child.given_up = True
        name = child.spec.name
        if child.spec.essential:
            what = f"gave up {name}; the experiment can't go on without it: {why}"
            self._end(EndReason.LOST, what)
        else:
            again = f"`afspm restart {name}` starts it again, Ctrl-C ends the run"
            is_last = child.spec.acts and all(other.is_over for other in self.children.values() if other.spec.acts)
            rest = f"the run ends in {IDLE_AFTER_S:.0f} s" if is_last and self._idle.ends else "the rest goes on"
            self._log(LOGGED_AS, "CRITICAL", f"gave up {name}; {rest}: {why}; {again}")

    def _advise(self, child: SupervisedChild) -> None:
        if child.spec.has_user_code and not (child.spec.essential or child.advised or child.given_up):
            child.advised = True
            name = child.spec.name
            later = f"if {name} is given up, `afspm restart {name}` starts it again"
            self._log(name, "INFO", f"correct the file, and the next restart loads it; {later}")

    def _end(self, why: EndReason, text: str) -> None:
        self._release()
        if self.ending is not None:
            return
        self.ending = RunEnd.begin(why, text, self._now_s)
        for child in self.children.values():
            is_missing = child.life is None and child.watch.phase is ChildPhase.WAITING
            child.watch.stop(self._now_s)
            if is_missing and self._may_be_rescued(child):
                self._rescue(child)
            # the scheduler announces the end to all others; a translator does not subscribe to it
            if child.spec.role is Role.TRANSLATOR and child.life:
                self._command(ProcessAction.CLOSE_INPUT, child)
        # the summary reports other ends in a moment; that a plan was given up is in the log already
        levels = {EndReason.STOPPED: "INFO", EndReason.LOST: "CRITICAL"}
        self._log(LOGGED_AS, levels.get(why, "DEBUG"), text)

    # --- the end ---

    def _may_be_rescued(self, child: SupervisedChild) -> bool:
        # a component that dies after the end of the experiment had not finished: it gets one more start to do so
        return self._has_just_ended and child.spec.beats and child.spec.role is Role.COMPONENT and not child.rescued

    def _is_unfinished(self, child: SupervisedChild, life: ChildLife, code: int) -> bool:
        # after an announced end a component finishes by itself, unless that takes too long or fails
        announced = self.ending is not None and self.ending.why.is_announced
        return announced and child.spec.role is Role.COMPONENT and (child.watch.died(code) or life.is_cut_short(code))

    @property
    def _has_just_ended(self) -> bool:
        ending = self.ending
        return ending is not None and ending.why.is_announced and ending.last is None

    def _rescue(self, child: SupervisedChild) -> None:
        child.rescued = True
        self._start(child)

    def _continue_ending(self, ending: RunEnd) -> None:
        if self._has_just_ended:
            self._release_scheduler()
        busy = unfinished(ending, self.children, self._now_s, self._liveness)
        if ending.last is EndStep.ASK:
            self._waited_for.update(busy)
        if not any(child.life and self._needs_grace(child) for child in self.children.values()):
            ending = replace(ending, busy_s=-math.inf)
        self.ending, step = ending.step(self._now_s, busy=bool(busy))
        postponed = step is None and self.ending.deadline_s() != ending.deadline_s()
        if busy and postponed and not self._has_told_waiting:
            self._has_told_waiting = True
            self._log(LOGGED_AS, "INFO", f"waiting for {', '.join(busy)} to finish; Ctrl-C ends it now")
        for child in self.children.values():
            if child.life is not None and step is not None:
                self._carry_out(step, child, child.life.pid)

    def _needs_grace(self, child: SupervisedChild) -> bool:
        # A process that was busy needs a moment to leave, and the scheduler and recorder then publish and record its
        # last packets. Any other process was asked to end long ago: a grace for it would be spent on a frozen one.
        return child.spec.name in self._waited_for or child.spec.leaves_last or child.spec.role is Role.SCHEDULER

    def _carry_out(self, step: EndStep, child: SupervisedChild, pid: int) -> None:
        match step:
            case EndStep.ASK:
                self._command(ProcessAction.CLOSE_INPUT, child)
            case EndStep.KILL:
                self._log(child.spec.name, "WARNING", "does not end: killed")
                self._command(ProcessAction.KILL, child)
            case EndStep.LEAVE:
                self._log(child.spec.name, "CRITICAL", f"can't be killed (process {pid})")
                self._command(ProcessAction.ABANDON, child)
                child.life = None

    def _release_scheduler(self) -> None:
        # Order: components, then the recorder, then the scheduler, so that the last packets are published and recorded.
        # Frozen components are killed; a busy one keeps END_WITHIN_S for what it has yet to write.
        left = [child for child in self.children.values() if child.life is not None]
        recorders = [child for child in left if child.spec.leaves_last]
        others = [child for child in left if child.spec.role is not Role.SCHEDULER and child not in recorders]
        for child in left:
            if not others and child in (recorders or left):
                if not (child.life and child.life.is_busy(self._now_s, self._liveness)):
                    self._command(ProcessAction.CLOSE_INPUT, child)
            elif self._may_be_rescued(child) and child.life and child.life.is_silent(self._now_s, self._liveness):
                self._command(ProcessAction.KILL, child)

    # --- effects ---

    def _with_role(self, role: Role) -> list[SupervisedChild]:
        return [child for child in self.children.values() if child.spec.role is role]

    def _release(self) -> None:
        if self._awaits_scheduler:
            self._awaits_scheduler = False
            self._effects.append(ReleaseComponents())

    def _command(self, action: ProcessAction, child: SupervisedChild) -> None:
        self._effects.append(ProcessCommand(action, child.spec.name))

    def _log(self, name: str, level: str, text: str) -> None:
        self._effects.append(WriteLog(name, level, text))
