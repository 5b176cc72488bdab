"""Who is in control, as the table of `arbitration` has it, and what follows from a change of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from afspm.logic import arbitration
from afspm.logic.arbitration import (
    ArbitrationState,
    Cause,
    ControlChange,
    ControlEvent,
    ControlInput,
    Rules,
    Transition,
)
from afspm.logic.controller_timeout import TRANSLATOR
from afspm.logic.descriptions import is_routine, said
from afspm.logic.event_log import EventLog
from afspm.logic.events import Log, Publish, RequestIn, SaveState
from afspm.logic.experiment_end import ExperimentEnd
from afspm.logic.lease import Lease
from afspm.logic.lifecycle import StartupBarrier
from afspm.logic.request_pipeline import RequestPipeline, reads
from afspm.logic.scheduler_publisher import SchedulerPublisher
from afspm.logic.sessions import token_of
from afspm.logic.watchdog import Watchdog
from afspm.model import ControlMode, ControlRequest, Problem, Request

CONTROL_EVENTS = {
    int(ControlRequest.REQUEST_CTRL): ControlEvent.REQUEST_CONTROL,
    int(ControlRequest.RELEASE_CTRL): ControlEvent.RELEASE_CONTROL,
    int(ControlRequest.ADD_EXP_PRBLM): ControlEvent.FLAG,
    int(ControlRequest.RMV_EXP_PRBLM): ControlEvent.CLEAR,
    int(ControlRequest.SET_CONTROL_MODE): ControlEvent.SET_MODE,
    int(ControlRequest.END_EXPERIMENT): ControlEvent.END,
}
"""The requests that may change control, by their numbers. All others are for the microscope."""


def ask_of(name: str, request: Request) -> ControlInput:
    """What a request of `name` asks of the table."""
    event = CONTROL_EVENTS.get(request.kind)
    if event is not None:
        return ControlInput(event, name, int(request.subject or 0))
    return ControlInput(ControlEvent.READ if reads(request) else ControlEvent.COMMAND, name)


@dataclass(frozen=True, slots=True)
class _Change:
    """ArbitrationState as it was and as it is, who asked, and by which row of the table.

    Attributes:
        had_died: the ask is of a holder in another life than that in which it got control.
    """

    before: ArbitrationState
    after: ArbitrationState
    ask: ControlInput
    row: Transition
    had_died: bool

    def was_cleared_by_others(self, problem: int, who: str) -> bool:
        """Whether somebody but `who` says that there is no such problem any more."""
        return problem in self.before.problems and problem not in self.after.problems and self.ask.who != who

    @property
    def cause(self) -> Cause | None:
        """Why the microscope may be left to itself: why control was taken, or that the experiment ends."""
        # a person at the microscope sees to it also when the experiment ends
        if self.after.ended and self.before.mode is not ControlMode.MANUAL:
            return Cause.ENDED
        return self.row.cause


class Arbiter:
    """Decides what is asked of control. What follows is appended to the effects of the desk, in its order.

    Attributes:
        control: who is in control, for what, and who flagged which problem.

    Args:
        catching_up: is over as soon as control is told.
        save: says what is to be saved.
    """

    def __init__(
        self,
        rules: Rules,
        desk: RequestPipeline,
        bulletin: SchedulerPublisher,
        chronicle: EventLog,
        watchdog: Watchdog,
        lease: Lease,
        catching_up: StartupBarrier,
        ending: ExperimentEnd,
        save: Callable[[], SaveState],
    ) -> None:
        self.control = ArbitrationState()
        self._rules = rules
        self._pipeline = desk
        self._bulletin = bulletin
        self._event_log = chronicle
        self._watchdog = watchdog
        self._lease = lease
        self._startup_barrier = catching_up
        self._ending = ending
        self._save = save
        self._granted_to: str | None = None  # the token of the life that got control
        self._holder_told: str | None = None

    def snapshot(self) -> dict[str, Any]:
        """What must survive a kill, as plain JSON."""
        return {"control": self.control.to_dict(), "granted_to": self._granted_to}

    def restore(self, state: dict[str, Any]) -> None:
        """Take up what `snapshot` wrote."""
        self.control = ArbitrationState.from_dict(state["control"])
        self._granted_to = state.get("granted_to")

    def decide(self, ask: ControlInput, event: RequestIn | None, now_s: float, now_ns: int) -> None:
        """Apply the table; `event` is the request to be answered, if somebody asked."""
        before = self.control
        row = arbitration.row_for(before, ask, self._rules)
        if ControlChange.FORWARD in row.do:
            assert event is not None
            self._pipeline.forward(event, now_s, now_ns, command=ask.event is ControlEvent.COMMAND)
            return
        self.control = after = arbitration.apply(row, before, ask)
        token = None if event is None else token_of(ask.who, event.request.id)
        if before.holder is None and after.holder is not None:
            self._granted_to = token
        if after != before:
            is_other_life = None not in (token, self._granted_to) and token != self._granted_to
            had_died = is_other_life and ask.who == before.holder
            self._follow(_Change(before, after, ask, row, had_died), now_s, now_ns)
        if after.ended and not before.ended:
            self._ending.begin(now_s)
        if event is not None and row.response is not None:
            self._ending.answer(event, row.response, arbitration.reason(row, before, ask, self._rules))

    def publish(self, now_s: float, now_ns: int) -> None:
        """Tell all peers who is in control."""
        publish = self._stamp(now_s, now_ns)
        self._pipeline.effects += [self._save(), publish]

    def _follow(self, change: _Change, now_s: float, now_ns: int) -> None:
        """Save, act and tell, in this order, before whoever asked is answered."""
        before, after = change.before, change.after
        self._event_log.changed(before, after, change.ask, change.row)
        self._lease.held_by(after.holder, now_ns)
        wanted = self._have_watched(change)
        publish = self._stamp(now_s, now_ns) if after.published() != before.published() else None
        self._pipeline.effects.append(self._save())
        self._tell_people(change, wanted)
        if after.ended:
            self._pipeline.call_back(None, Cause.ENDED)
        elif before.holder is not None and after.holder is None:
            self._pipeline.call_back(before.holder, change.row.cause)
        elif before.mode is ControlMode.MANUAL and after.mode is not ControlMode.MANUAL:
            self._pipeline.call_back(None, None)
        self._pipeline.errands.send(now_s)
        if publish is not None:
            self._pipeline.effects.append(publish)

    def _have_watched(self, change: _Change) -> list[str]:
        """The microscope may have been left to itself. Returns what the watchdog wants because of that."""
        cause, former = change.cause, change.before.holder
        if change.was_cleared_by_others(Problem.DEVICE_MALFUNCTION, TRANSLATOR):
            self._watchdog.put_right()
        if cause is None or (former is None and cause not in (Cause.MANUAL, Cause.ENDED)):
            return []
        if self._pipeline.switches_feedback_off():
            self._watchdog.danger.feedback_may_be_off()
        return self._watchdog.control_taken(
            cause,
            self._pipeline.action_in_flight(),
            had_died=change.had_died,
            by_holder=change.ask.who == former,
            was_seen_to=change.before.sees_to_tip,
        )

    def _stamp(self, now_s: float, now_ns: int) -> Publish:
        """The control state as a packet, which has its time before it is published: that is saved first."""
        self._startup_barrier.over(now_s)
        return self._bulletin.control(self.control.published(), now_ns)

    def _tell_people(self, change: _Change, wanted: list[str]) -> None:
        before, after, ask, cause = change.before, change.after, change.ask, change.cause
        routine = is_routine(before, after, ask, self._holder_told)
        self._log("DEBUG" if routine else "INFO", said(before, after, ask, change.row, self._rules))
        self._holder_told = after.holder or self._holder_told
        is_sent = (
            "is sent to the microscope" if self._pipeline.forwarder.up else "will be sent when the translator is back"
        )
        for action in wanted:
            why = f"{before.holder} had died in control" if change.had_died else cause.value if cause else ""
            self._log("WARNING", f"{action} {is_sent}, since {why}")
        from_hand = before.mode is ControlMode.MANUAL and after.mode is not ControlMode.MANUAL
        if (cause is None and not from_hand) or self._watchdog.owes_retract:
            return
        if (danger := self._watchdog.danger.untold()) is not None:
            expected = cause in (None, Cause.RELEASED, Cause.SOLVED, Cause.MANUAL)
            why = cause.value if cause else "the mode is automated again"
            self._log("WARNING" if expected else "CRITICAL", f"{danger}, and nobody looks after it: {why}")

    def _log(self, level: str, text: str) -> None:
        self._pipeline.effects.append(Log(level, text))
